"""Finished runs: what they hold, and changed copies of them."""

import json
import shutil
from pathlib import Path

import pycolmap
from databases import content

from jaxsfm.colmap.model_files import read_model, write_models
from jaxsfm.colmap.reconstruction import part_of, registered

HOSTILE = "<img src=x onerror=document.title='owned'><b>&amp;.png"
"""A file name that would do harm or look wrong if it were not escaped."""


def change_report(out: Path, change) -> Path:
    """Rewrite report.json after a function has changed its content."""
    path = out / "report.json"
    report = json.loads(path.read_text())
    change(report)
    path.write_text(json.dumps(report))
    return out


def with_two_models(out: Path) -> Path:
    """Put a model before the first one: the same without one photo and two thirds of its points."""
    whole = read_model(out / "sparse" / "0")
    names = sorted(registered(whole))
    few = part_of(whole, [names[0], names[-1]])
    for k, number in enumerate(sorted(few.points3D)):
        if k % 3:
            few.delete_point3D(number)
    write_models([few, whole], out / "sparse")

    def change(report: dict) -> None:
        (ours,) = report["models"]
        report["models"] = [ours | {"images": sorted(registered(few)), "registered": 2}, ours]
        report["checks"] = [None, *report["checks"]]

    return change_report(out, change)


def renamed(out: Path, images: Path, to: Path, old: str, new: str) -> tuple[Path, Path]:
    """Copy a run and its photos, and give one image another name everywhere."""
    run, photos = to / "run", to / "images"
    shutil.copytree(out, run)
    shutil.copytree(images, photos)
    (photos / old).rename(photos / new)
    quoted = {json.dumps(old): json.dumps(new)}
    for name in ("report.json", "run.json"):
        text = (run / name).read_text()
        for before, after in quoted.items():
            text = text.replace(before, after)
        (run / name).write_text(text)
    model = pycolmap.Reconstruction(run / "sparse" / "0")
    for image_id in list(model.images):
        if model.image(image_id).name == old:
            model.image(image_id).name = new
    model.write(run / "sparse" / "0")
    change_report(run, lambda report: report["images"].update(folder=str(photos)))
    return run, photos


def results(out: Path) -> dict[str, object]:
    """What a run leaves that must not depend on how it came there."""
    files = [*out.glob("matches/*/*"), *out.glob("sparse/*/*")]
    report = json.loads((out / "report.json").read_text())
    return {
        **{str(file.relative_to(out)): file.read_bytes() for file in files},
        "database": content(out / "database.db"),
        "report": {
            name: report[name] for name in ("identity", "pairs", "models", "lost", "refinement")
        },
    }
