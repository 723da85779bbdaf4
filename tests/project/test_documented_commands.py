"""Every command that the documentation shows can be given as it stands.

Short ones run. Of long ones (runs, trainings, benchmarks, downloads) all is done up to the work
itself: the command line is parsed, options and files are checked, and the function that would do
the work is called with arguments that it takes.
"""

import importlib
import inspect
import pkgutil
import re
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import jaxsfm
from jaxsfm.cli.main import main

ROOT = Path(__file__).parents[2]
PAGES = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "notebooks/README.md",
    ROOT / "weights_conversion/README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
)
LONG = (
    "jaxsfm.runs.reconstruct.reconstruct_folder",
    "jaxsfm.runs.reconstruct.reconstruct_video",
    "jaxsfm.runs.video.frames.frames_folder",
    "jaxsfm.bench.demo.run_demo",
    "jaxsfm.matching.retrieval.shortlist",
    "jaxsfm.runs.localize.localize_photos",
    "jaxsfm.runs.extend.extend_run",
    "jaxsfm.runs.refine.refine_folder",
    "jaxsfm.runs.merge.merge_folders",
    "jaxsfm.training.relocalizer.train_relocalizer",
    "jaxsfm.matching.extraction.image_features",
    "jaxsfm.bench.datasets.fetch",
    "jaxsfm.report.viewer.serve",
    "jaxsfm.weights_conversion.convert.read_source",
    "jaxsfm.weights_conversion.fetch.fetch_weights",
    *(
        f"jaxsfm.bench.{name}.bench_{name}"
        for name in ("ledger", "strecha", "daynight", "ambiguous", "sequence", "wxbs")
    ),
)
FENCED = re.compile(r"^```(?:bash|text)\n(.*?)^```", re.MULTILINE | re.DOTALL)
IN_FENCE = re.compile(r"^(?: {4}\$ |\$ |)(jaxsfm [a-z-].*)$", re.MULTILINE)
INDENTED = re.compile(r"^ {4}(?:\.venv/bin/)?(jaxsfm [a-z-].*)$", re.MULTILINE)
INLINE = re.compile(r"`(jaxsfm [a-z]+ [^`]*--[^`]*)`")
FOLDERS = (*("PHOTOS", "images", "FOLDER", "DIR", "SETS", "SCENES", "FRAMES", "PAIRS", "DATA"),)
"""Names of folders in the documentation."""
SHELL = {
    '"$(jaxsfm data path wxbs)"': "DIR",
    '"out/$(basename "$scene")"': "NEW",
    '"$scene"': "PHOTOS",
}
"""What a shell would have put there."""


def commands() -> list[tuple[str, str]]:
    """Page and command, each command once."""
    found: dict[str, str] = {}
    for page in PAGES:
        text = page.read_text()
        fenced = [command for block in FENCED.findall(text) for command in IN_FENCE.findall(block)]
        for command in (*fenced, *INDENTED.findall(text), *INLINE.findall(text)):
            command = re.sub(r"\s+#.*", "", " ".join(command.split()))
            found.setdefault(command, str(page.relative_to(ROOT)))
    return [(page, command) for command, page in found.items()]


class Reached(Exception):
    """A long function was called with arguments that it takes."""


@pytest.fixture
def home(plain, scene, tmp_path, monkeypatch):
    """A folder in which all the names exist that the documentation uses."""
    photos = sorted((scene / "images").iterdir())
    for name in FOLDERS:
        shutil.copytree(scene / "images", tmp_path / name)
    shutil.copytree(plain[0], tmp_path / "OUT")
    for name in ("POSES", "SET"):
        shutil.copytree(scene / "reference", tmp_path / name)
    for name in ("SET/images", "sacre_coeur/mapping"):
        shutil.copytree(scene / "images", tmp_path / name)
    shutil.copy(scene / "K.txt", tmp_path / "SET/images")
    for name, photo in (("A.jpg", photos[0]), ("B.jpg", photos[1])):
        shutil.copy(photo, tmp_path / name)
        white = np.full(cv2.imread(str(photo)).shape[:2], 255, np.uint8)
        assert cv2.imwrite(str(tmp_path / f"{name}.png"), white)
    for folder in (tmp_path, tmp_path / "images"):
        shutil.copy(scene / "K.txt", folder)
    (tmp_path / "VIDEO.mp4").touch()
    (tmp_path / "pairs.txt").write_text(f"{photos[0].name} {photos[1].name}\n")
    shutil.copy(ROOT / "jaxsfm/relocalizer.safetensors", tmp_path / "mine.safetensors")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXSFM_DATA", str(tmp_path / "data"))
    for each in pkgutil.walk_packages(jaxsfm.__path__, "jaxsfm."):
        # Before anything is replaced: a module that is imported later would keep the replacement.
        if not each.name.endswith("__main__"):
            importlib.import_module(each.name)
    for path in LONG:
        module, _, name = path.rpartition(".")
        original = getattr(importlib.import_module(module), name)

        def reached(*args, original=original, **kwargs):
            inspect.signature(original).bind(*args, **kwargs)
            raise Reached

        monkeypatch.setattr(path, reached)
    return tmp_path


@pytest.mark.parametrize(("page", "command"), commands(), ids=lambda value: str(value)[:60])
def test_a_documented_command_works_as_it_stands(page, command, home, capsys):
    for shell, name in SHELL.items():
        command = command.replace(shell, name)
    words = shlex.split(command)
    try:
        status = main(words[1:])
    except Reached:
        return
    captured = capsys.readouterr()
    assert status == 0, f"{page}: {captured.err}"


def test_there_are_commands_in_the_documentation():
    found = commands()
    assert len(found) > 30 and {page for page, _ in found} >= {"README.md", "docs/index.md"}
