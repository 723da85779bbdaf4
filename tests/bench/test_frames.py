"""Laws of the folders with links to some photos."""

from jaxsfm.bench.inputs import linked


def names(folder) -> dict[str, str]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in found}


def test_a_folder_has_the_asked_photos_of_the_asked_folder_and_no_others(tmp_path):
    for folder in ("one", "two"):
        for name in ("a.jpg", "night/b.jpg", "night/c.jpg"):
            path = tmp_path / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{folder} {name}")
    target = tmp_path / "links"
    linked(tmp_path / "one", ["a.jpg", "night/b.jpg"], target)
    assert names(target) == {"a.jpg": "one a.jpg", "night/b.jpg": "one night/b.jpg"}
    linked(tmp_path / "two", ["night/b.jpg", "night/c.jpg"], target)
    assert names(target) == {"night/b.jpg": "two night/b.jpg", "night/c.jpg": "two night/c.jpg"}
    (tmp_path / "two" / "night" / "b.jpg").unlink()
    linked(tmp_path / "one", ["night/b.jpg"], target)
    assert names(target) == {"night/b.jpg": "one night/b.jpg"}
