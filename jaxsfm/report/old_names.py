"""Reads reports of format 1 and 2, in which some keys had other names."""

from collections.abc import Sequence

RENAMED_IN = 3
"""The format whose reports have the new names."""
EACH = "*"
"""All items of a list."""
RENAMED: tuple[tuple[tuple[str, ...], str], ...] = (
    (("looks",), "low_resolution"),
    (("low_resolution", "first_px"), "px"),
    (("options", "config", "first_look"), "low_resolution"),
    (("options", "config", "first_look_share"), "low_resolution_share"),
    (("options", "config", "closer_looks"), "max_rectified_planes"),
    (("pairs", "each", EACH, "view_graph", "strength"), "edge_weight"),
    (("pairs", "each", EACH, "view_graph", "refuted"), "rejected"),
    (("view_graph", "components", EACH, "nearest", "strength"), "edge_weight"),
    (("lost", EACH, "best_pair", "strength"), "edge_weight"),
    (("refinement", EACH, "placed"), "registrations"),
    (("refinement", EACH, "registrations", EACH, "doubt"), "reason"),
    (("checks", EACH, "other_places"), "pose_ambiguities"),
    (("checks", EACH, "told_apart"), "split_groups"),
    (("checks", EACH, "shrunk"), "scale_drift"),
    (("extended", EACH, "placed"), "registered"),
)
"""The path of a key under its old name, and its new name. Paths before it have new names."""


def with_new_names(report: object) -> object:
    """A report whose keys have the names of this version; the given one stays as it is."""
    if isinstance(report, dict) and report.get("format") == RENAMED_IN:
        return report  # looking through 100,000 pairs takes longer than reading them
    for path, new in RENAMED:
        report = _renamed(report, path, new)
    return report


def _renamed(value: object, path: Sequence[str], new: str) -> object:
    """A value in which the key at the end of a path has another name."""
    key, *rest = path
    if key == EACH and isinstance(value, list):
        return [_renamed(each, rest, new) for each in value]
    if not isinstance(value, dict) or key not in value:
        return value
    if rest:
        return value | {key: _renamed(value[key], rest, new)}
    if new in value:
        return value
    return {new if name == key else name: each for name, each in value.items()}
