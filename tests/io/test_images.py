"""Finding and checking images. PNGs are written by cv2 only (see jaxsfm.colmap)."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from jaxsfm.config import MIN_SIDE
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, inspect_image, read_image
from jaxsfm.io.photo_folder import find_images


def write_png(path: Path, rgb: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), rgb)
    return path


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def jpeg(path: Path, rgb: np.ndarray, **options) -> Path:
    Image.fromarray(rgb).save(path, "JPEG", quality=95, **options)
    return path


# -- finding --------------------------------------------------------------------------------------


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_missing_folder_a_file_and_an_empty_folder_are_refused_by_name(tmp_path):
    touch(tmp_path, "file.jpg", "empty/K.txt")
    for path, message in (
        (tmp_path / "none", "no such folder"),
        (tmp_path / "file.jpg", "not a folder"),
        (tmp_path / "empty", "there are no images in this folder"),
    ):
        with pytest.raises(UserError, match=message) as error:
            find_images(path)
        assert str(path) in str(error.value)


def test_subfolders_keep_equal_base_names_apart(tmp_path):
    touch(tmp_path, "b/0.jpg", "a/0.jpg", "a/deep/0.png", "1.TIF")
    assert find_images(tmp_path) == ["1.TIF", "a/0.jpg", "a/deep/0.png", "b/0.jpg"]


def test_odd_names_are_found_and_other_files_are_not(tmp_path):
    good = ["a b.jpg", "café/日本.png", "new\nline.jpg", "-dash.bmp", "x.jpg.JPEG"]
    other = ["K.txt", ".hidden.jpg", ".cache/a.jpg", "sub/.thumb/b.png", "notes.jpg.txt", "jpg"]
    touch(tmp_path, *good, *other)
    (tmp_path / "folder.jpg").mkdir()
    assert find_images(tmp_path) == sorted(good)


def test_a_hidden_parent_of_the_folder_does_not_hide_the_images(tmp_path):
    touch(tmp_path, ".work/photos/a.jpg")
    assert find_images(tmp_path / ".work" / "photos") == ["a.jpg"]


# -- inspecting -----------------------------------------------------------------------------------


def test_what_is_not_an_image_is_refused_in_one_line_that_names_it(tmp_path):
    (tmp_path / "zero.jpg").touch()
    (tmp_path / "text.jpg").write_text("not an image")
    (tmp_path / "line\nbreak.jpg").write_text("not an image")
    cases = {"none.jpg": "cannot be read", "zero.jpg": "empty", "text.jpg": "not a readable image"}
    for name, message in {**cases, "line\nbreak.jpg": "not a readable image"}.items():
        with pytest.raises(ImageError, match=message) as error:
            inspect_image(tmp_path / name, name=name)
        assert str(error.value).startswith(name.replace("\n", r"\n") + ":")
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(("side", "usable"), [(1, False), (20, False), (MIN_SIDE, True)])
def test_an_image_below_one_matching_window_is_too_small(tmp_path, side, usable):
    path = write_png(tmp_path / "a.png", noise(side, side))
    if usable:
        image = inspect_image(path, name="sub/a.png")
        assert (image.name, image.size) == ("sub/a.png", (side, side))
        assert read_image(image, max_size=1600).rgb.shape == (side, side, 3)
    else:
        with pytest.raises(ImageError, match=f"a.png: {side} x {side} pixels is too small"):
            inspect_image(path)


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("part", [0.02, 0.5, 0.9, 0.999])
def test_a_truncated_jpeg_is_refused_before_decoding(tmp_path, part, progressive):
    data = jpeg(tmp_path / "a.jpg", noise(96, 96), progressive=progressive).read_bytes()
    (tmp_path / "cut.jpg").write_bytes(data[: int(part * len(data))])
    with pytest.raises(ImageError, match="cut.jpg"):
        inspect_image(tmp_path / "cut.jpg")


def test_a_truncated_png_is_refused_when_decoded(tmp_path):
    data = write_png(tmp_path / "a.png", noise(96, 96)).read_bytes()
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(ImageError, match="cut.png"):
        read_image(inspect_image(tmp_path / "cut.png"), max_size=1600)


def test_a_jpeg_with_bytes_after_its_end_is_whole(tmp_path):
    """Phones append a film, in which there may be the bytes of an SOS marker."""
    path = jpeg(tmp_path / "motion.jpg", noise(64, 96))
    path.write_bytes(path.read_bytes() + b"film \xff\xda film")
    assert inspect_image(path).size == (96, 64)


def test_a_name_that_is_not_text_is_refused_before_the_work(tmp_path):
    """COLMAP's database takes UTF-8 only; without the check a run would end after its matching."""
    name = "caf\udce9.png"  # Latin-1 bytes, as the file system hands them over
    write_png(tmp_path / "a.png", noise(64, 64)).rename(tmp_path / name)
    assert find_images(tmp_path) == [name]
    with pytest.raises(ImageError, match=r"caf\\udce9.png") as error:
        inspect_image(tmp_path / name, name=name)
    assert "\n" not in str(error.value) and str(error.value).isascii()


def test_images_of_the_same_content_share_their_identity(tmp_path):
    a, b = (inspect_image(write_png(tmp_path / n, noise(64, 64))) for n in ("a.png", "b.png"))
    other = inspect_image(write_png(tmp_path / "c.png", noise(64, 64, seed=1)))
    assert a.sha256 == b.sha256 and a.identity == b.identity != other.identity
    assert 0 <= a.identity < 2**32


def test_only_our_own_limit_refuses_a_large_jpeg(tmp_path):
    """Pillow's own limit (179 million pixels) is below MAX_DECODED_PIXELS."""
    data = bytearray(jpeg(tmp_path / "a.jpg", noise(64, 64)).read_bytes())
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = 2 * (20_000).to_bytes(2, "big")
    (tmp_path / "large.jpg").write_bytes(data)
    assert inspect_image(tmp_path / "large.jpg").size == (20_000, 20_000)
