"""Odd values in any field of a stranger's model: what commands make of it, or one sentence."""

import functools
import shutil
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
from foreign_model import CAMERAS, NAMES, SIZE, camera, exact_model
from fuzz_children import run_cases
from mutations import outcome

from jaxsfm.cli.export_commands import export
from jaxsfm.colmap.given_model import looks_calibrated, read_given_model
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.colmap.model_files import read_model
from jaxsfm.runs.merge import merge_folders

POINTS = 20
FORMATS = ("colmap", "colmap-text", "ply", "nerfstudio")
ODD_NAMES = ["", ".", "/", "..", "a.jpg", "./a.jpg", "a.jpg/", "a.jpg/b", "sub", "sub//b.jpg"]
ODD_NAMES += [
    "../a.jpg",
    "/a.jpg",
    "a\nb.jpg",
    "a b.jpg",
    "#a.jpg",
    "x" * 300,
    "x/" * 3000,
    "\u65e5",
]
ODD_REALS = [0.0, -1.0, 0.5, 1e-300, 1e-9, 1e9, 1e99, -1e99, 1e200, np.inf, -np.inf, np.nan]
ODD_WORDS = ["", "x", "-1", "0", "1", "2", "77", "1.5", "1e9", "1e99", "1e400", "nan", "-inf"]
ODD_WORDS += [
    "4294967295",
    "4294967296",
    "2147483648",
    "18446744073709551615",
    "99999999999999999999",
]
ODD_WORDS += ["PINHOLE", "OPENCV", "EQUIRECTANGULAR", "CAMERA", "IMU", "\0", "0x10", "\u0663"]
ODD_ALREADY = (ValueError, struct.error, AssertionError, TypeError, OverflowError)
"""What a walk over a file raises that has an odd field already."""


class Field(NamedTuple):
    """A value in a binary file."""

    at: int
    layout: str
    """Its letter in `struct`; s for a name."""


class Walk:
    """Walks over the fields of a binary file, and notes where each entry begins."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 8
        self.fields: list[Field] = [Field(0, "Q")]
        self.entries: list[int] = []

    def take(self, layout: str) -> tuple:
        found = []
        for letter in layout:
            self.fields.append(Field(self.at, letter))
            found += struct.unpack_from("<" + letter, self.data, self.at)
            self.at += struct.calcsize("<" + letter)
        return tuple(found)

    def name(self) -> None:
        self.fields.append(Field(self.at, "s"))
        self.at = self.data.index(b"\0", self.at) + 1

    def rest(self, count: int, layout: str) -> None:
        """Fields that come `count` times, of which the first ones are enough."""
        start = self.at
        for _ in range(min(count, 2)):
            self.take(layout)
        self.at = start + count * struct.calcsize("<" + layout)


def walked(name: str, data: bytes) -> Walk:
    walk = Walk(data)
    (count,) = struct.unpack_from("<Q", data)
    for _ in range(count):
        walk.entries.append(walk.at)
        if name == "cameras.bin":
            model = walk.take("IiQQ")[1]
            kind = pycolmap.CameraModelId(model)
            walk.take("d" * len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params))
        elif name == "images.bin":
            walk.take("I" + "d" * 7 + "I")
            walk.name()
            walk.rest(walk.take("Q")[0], "ddQ")
        elif name == "frames.bin":
            walk.take("II" + "d" * 7)
            walk.rest(walk.take("I")[0], "iIQ")
        elif name == "rigs.bin":
            for k in range(walk.take("II")[1]):
                walk.take("iI")
                if k and walk.take("B")[0]:
                    walk.take("d" * 7)
        else:
            walk.take("QdddBBBd")
            walk.rest(walk.take("Q")[0], "II")
    assert walk.at == len(data)
    return walk


def wholes(folder: Path) -> list[Path]:
    """Right models, made once: with cameras of all kinds, and with a rig; and their photos."""
    home = folder / "wholes"
    if not home.exists():
        for k, names in enumerate([["PINHOLE", "OPENCV"], list(CAMERAS)[:4], list(CAMERAS)[4:]]):
            (home / str(k)).mkdir(parents=True)
            cameras = [camera(name, k + 1) for k, name in enumerate(names)]
            exact_model(cameras, points=POINTS).write_binary(home / str(k))
        options = pycolmap.SyntheticDatasetOptions(
            num_cameras_per_rig=2, num_frames_per_rig=2, num_points3D=POINTS
        )
        (home / "3").mkdir()
        pycolmap.synthesize_dataset(options).write_binary(home / "3")
        for name in NAMES:
            (folder / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
            grey = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
            cv2.imwrite(str(folder / "photos" / name), grey)
    return sorted(home.iterdir())


def pick(rng, choices):
    return choices[int(rng.integers(len(choices)))]


def odd_bytes(name: str, data: bytes, rng) -> bytes:
    """A binary file with one odd field, or with an entry twice or missing."""
    walk = walked(name, data)
    if walk.entries and rng.random() < 0.1:
        ends = [*walk.entries[1:], len(data)]
        k = int(rng.integers(len(ends)))
        entry, change = data[walk.entries[k] : ends[k]], int(rng.choice([-1, 1]))
        count = struct.pack("<Q", len(ends) + change)
        put = entry * 2 if change == 1 else b""
        return count + data[8 : walk.entries[k]] + put + data[ends[k] :]
    # The few fields of a kind are tried as often as the many.
    letter = pick(rng, sorted({field.layout for field in walk.fields}))
    at, layout = pick(rng, [field for field in walk.fields if field.layout == letter])
    if layout == "s":
        return data[:at] + pick(rng, ODD_NAMES).encode() + data[data.index(b"\0", at) :]
    size = struct.calcsize(layout)
    if layout == "d":
        new = struct.pack("<d", pick(rng, ODD_REALS))
    else:
        own = int.from_bytes(data[at : at + size], "little")
        bits = 8 * size
        odd = [0, 1, 2, 3, own + 1, own - 1, 77, 1 << bits - 1, (1 << bits) - 1, (1 << bits) - 2]
        new = (pick(rng, odd) % (1 << bits)).to_bytes(size, "little")
    return data[:at] + new + data[at + size :]


def odd_text(text: str, rng) -> bytes:
    """A text file with an odd word, or with a line twice or missing."""
    lines = text.split("\n")
    full = [k for k, line in enumerate(lines) if line and not line.startswith("#")]
    k = pick(rng, full or [0])
    if rng.random() < 0.15:
        lines[k : k + 1] = [lines[k]] * int(rng.choice([0, 2]))
        return "\n".join(lines).encode()
    words = lines[k].split(" ")
    at = (
        int(rng.integers(len(words)))
        if rng.random() < 0.5
        else min(int(rng.integers(10)), len(words) - 1)
    )
    words[at] = pick(rng, ODD_WORDS + ODD_NAMES[:11])
    lines[k] = " ".join(words)
    return "\n".join(lines).encode()


def odd_model(rng, folder: Path) -> Path:
    """A copy of a right model with one or two odd fields."""
    whole, bad = pick(rng, wholes(folder)), folder / "bad"
    shutil.rmtree(bad, ignore_errors=True)
    bad.mkdir()
    text = rng.random() < 0.4
    model = pycolmap.Reconstruction(whole)
    (model.write_text if text else model.write_binary)(bad)
    for _ in range(rng.integers(1, 3)):
        path = pick(rng, sorted(bad.iterdir()))
        try:
            data = path.read_bytes()
            odd = odd_text(data.decode(), rng) if text else odd_bytes(path.name, data, rng)
        except ODD_ALREADY:
            continue
        path.write_bytes(odd)
    return bad


def odd(rng, folder: Path) -> str:
    """Read by `refine` and `merge`, and exported in any format."""
    bad, out, photos = odd_model(rng, folder), folder / "out", folder / "photos"
    known = (bad, photos, "--to ", *map(repr, ODD_NAMES), *NAMES, *ODD_NAMES[4:])
    how, model = outcome(lambda: read_model(bad), bad)
    if how == "refused":
        return how
    given, one = outcome(lambda: read_given_model(bad), bad)
    if given == "read":
        looks_calibrated(one)
        arrays = Model.from_colmap(model, stored_sizes(model))
        assert np.isfinite(arrays.tracks.points).all()
        arrays.errors_px()
    formats = [pick(rng, FORMATS), *(["undistorted"] if rng.random() < 0.05 else [])]
    for to in formats:
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        target = out / ("points.ply" if to == "ply" else "made")
        copied = to == "nerfstudio" and rng.random() < 0.5
        write = functools.partial(export, bad, to=to, out=target, images=photos)
        made, _ = outcome(functools.partial(write, copy_images=copied), *known)
        assert target.exists() == (made == "read")
        assert sorted(out.iterdir()) == [target] * (made == "read")
    if given == "read" and rng.random() < 0.1:
        shutil.rmtree(out, ignore_errors=True)
        pair = [bad, wholes(folder)[0]][:: int(rng.choice([1, -1]))]
        outcome(lambda: merge_folders(*pair, out, threads=1), bad)
    return how


def test_an_odd_model_is_used_or_refused_by_name(tmp_path, share, least):
    found = run_cases(
        "test_fuzz_odd_models", "odd", round(1500 * share), tmp_path, patience_s=600 * share + 60
    )
    assert found["read"] > 200 * least and found["refused"] > 300 * least
