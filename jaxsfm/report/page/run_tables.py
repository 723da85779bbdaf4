"""The tables of times and options, and what to do next."""

import shlex
from collections.abc import Mapping
from pathlib import Path

from jaxsfm.report.page.verdict import duration


def stage_table(seconds: Mapping[str, float]) -> list[tuple[str, str, float]]:
    """Each stage with its time, and its share of the longest time."""
    longest = max(seconds.values(), default=0.0) or 1.0
    return [(stage, duration(s), s / longest) for stage, s in seconds.items()]


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value is None else str(value)


def option_table(options: object, prefix: str = "") -> list[tuple[str, str]]:
    """Nested options as rows of a name and a value."""
    if not isinstance(options, Mapping):
        return [(prefix.removesuffix("."), _shown(options))]
    return [row for name, each in options.items() for row in option_table(each, f"{prefix}{name}.")]


def next_steps(folder: Path, images: Path | None, *, model: bool) -> list[tuple[str, str]]:
    """What to do with the result: sentences, each with a command.

    Args:
      folder: the folder of the results.
      images: the folder of the photos.
      model: whether there is a model.
    """
    out = folder.absolute()
    quoted = shlex.quote(str(out))
    photos = shlex.quote(str(images.absolute())) if images else "PHOTOS"
    if model:
        steps = [
            ("Look at the model with its photos in the browser", f"jaxsfm view {quoted}"),
            ("Compare it with known poses", f"jaxsfm evaluate {quoted} --reference POSES"),
            (
                "Open it in COLMAP, to look at it or for a dense reconstruction",
                f"colmap gui --import_path {shlex.quote(str(out / 'sparse' / '0'))} "
                f"--database_path {shlex.quote(str(out / 'database.db'))} --image_path {photos}",
            ),
            ("Read it in Python", f"pycolmap.Reconstruction({str(out / 'sparse' / '0')!r})"),
        ]
    else:
        again = f"jaxsfm reconstruct {photos} --out NEW --preset robust"
        steps = [("Try again with enlarged photos", again)]
    return [*steps, ("Write this page again", f"jaxsfm report {quoted} --images {photos}")]
