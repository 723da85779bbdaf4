"""Change copies of a finished run."""

import json
import shutil
from pathlib import Path

import pycolmap

HOSTILE = "<img src=x onerror=document.title='owned'><b>&amp;.png"
"""A file name that would do harm or look wrong if it were not escaped."""


def change_report(out: Path, change) -> Path:
    """Rewrite report.json after a function has changed its content."""
    path = out / "report.json"
    report = json.loads(path.read_text())
    change(report)
    path.write_text(json.dumps(report))
    return out


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
