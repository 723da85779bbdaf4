"""What report.json must hold for those that read it: the page, the viewer, the exports."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import read_json

Shape = Any
"""A predicate; a tuple: any of these; a list: a list of this; a dict: at least these keys, those
that end with ? if they are there, key * all of them; None: null."""


def count(value: Any) -> bool:
    """A number of things."""
    return type(value) is int and 0 <= value < 2**53


def number(value: Any) -> bool:
    """Finite, and none that arithmetic with it makes infinite."""
    return type(value) in (int, float) and bool(abs(value) < 1e30)


def text(value: Any) -> bool:
    return isinstance(value, str)


def flag(value: Any) -> bool:
    return isinstance(value, bool)


def _pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(text, value))


def _positive(value: Any) -> bool:
    return number(value) and 1 <= value < 2**31


def _side(value: Any) -> bool:
    return count(value) and 1 <= value < 2**31


def _threads(value: Any) -> bool:
    return value == -1 or _side(value)


def _status(value: Any) -> bool:
    return text(value) and value.upper() in Status.__members__


_ERRORS = {"mean": number, "median": number, "max": number}
_NEAREST = {"pair": _pair, "missed": text}
SIZES: Shape = {"options": {"config": {"max_size": _side, "enlarge": _positive}}}
"""How large working images were."""
PHOTOS: Shape = {"images": {"folder": text}}
"""Where the photos lay."""
REPORT: Shape = {
    "version": text,
    "versions?": {"*": text},
    "finished?": text,
    "identity": {"version": text, "images": {"*": text}, "config": {}},
    "weights": {},
    "options": {
        "config": {"max_size": _side, "enlarge": _positive},
        "seed": count,
        "threads": _threads,
        "pairs": text,
        "intrinsics": (text, None),
        "reference?": (text, None),
    },
    "images": {
        "folder?": (text, None),
        "found": count,
        "usable": count,
        "skipped": {"*": text},
    },
    "pairs": {
        **dict.fromkeys(("tried", "verified", "handed_on", "overflowed"), count),
        "each": [
            {
                "pair": _pair,
                "status": _status,
                "tentative": count,
                "inliers": count,
                "planes": count,
                "handed_on": flag,
                "colmap_inliers": count,
                "view_graph": (
                    None,
                    {
                        "trusted": flag,
                        "strength": number,
                        "rotation_error_deg": (number, None),
                        "reason": text,
                    },
                ),
            }
        ],
    },
    "models": [
        {
            "registered": count,
            "points": count,
            "track_length": number,
            "reprojection_error_px": number,
            "images": [text],
        }
    ],
    "lost": [
        {
            "image": text,
            "stage": text,
            "detail": text,
            "help?": [{"option": (text, None), "reason": text}],
        }
    ],
    "no_model?": (text, None),
    "view_graph?": {
        "components": [
            {"images": [text], "pairs": count, "registered": count, "nearest": (None, _NEAREST)}
        ]
    },
    "evaluation?": {
        "registered": count,
        "reference_images": count,
        "aligned_on": count,
        "position": _ERRORS,
        "rotation_deg": _ERRORS,
        "within_10deg": {"*": number},
        "images": {"*": {"position": number, "rotation_deg": number}},
    },
    "evaluation_failed?": text,
    "seconds": {"*": number},
}


def misfit(value: Any, shape: Shape, where: str = "") -> str | None:
    """Where a value is not what it must be; None: nowhere."""
    if isinstance(shape, tuple):
        places = [misfit(value, one, where) for one in shape]
        return None if None in places else max(places, key=lambda place: len(place or ""))
    if isinstance(shape, list):
        if not isinstance(value, list):
            return where
        entries = [(str(key), item, shape[0]) for key, item in enumerate(value)]
    elif isinstance(shape, Mapping):
        if not isinstance(value, dict):
            return where
        entries = _entries(value, shape)
    else:
        return None if (value is None if shape is None else shape(value)) else where
    places = (misfit(item, one, f"{where}.{key}".lstrip(".")) for key, item, one in entries)
    return next((place for place in places if place is not None), None)


_ABSENT = object()


def _entries(
    value: Mapping[str, Any], shape: Mapping[str, Shape]
) -> Iterator[tuple[str, Any, Shape]]:
    for name, one in shape.items():
        if name == "*":
            yield from ((key, item, one) for key, item in value.items())
        elif not name.endswith("?"):
            yield name, value.get(name, _ABSENT), one
        elif name[:-1] in value:
            yield name[:-1], value[name[:-1]], one


def read_report(folder: Path, shape: Shape = REPORT) -> dict[str, Any]:
    """A run's report.json.

    Args:
      shape: of what is wanted of it.

    Raises:
      UserError: there is none, or it is not what this version's readers need.
    """
    report = read_json(folder / "report.json")
    if report is None:
        raise UserError(f"{folder}: no finished run here (report.json is missing or damaged)")
    place = misfit(report, shape)
    if place is not None:
        what = place or "its content"
        raise UserError(f"{folder}: report.json is damaged, or of another version ({what!r})")
    return report
