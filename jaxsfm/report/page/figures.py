"""Figures of the page, and how names and numbers are written in them."""

import html
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import plotly.graph_objects as go
from plotly.basedatatypes import BaseTraceType

from jaxsfm.io.images import shown_name

BLUE, ORANGE, GREEN, GREY = "#3b82c4", "#e07b39", "#3f9d6b", "#8a94a3"
"""Colours that are legible on light and dark ground, and that colour-blind readers can tell
apart."""


class Figure(NamedTuple):
    """A figure that plotly draws in the browser."""

    spec: str
    """Data and layout as JSON, with numbers in base64. plotly escapes < and > in it, so that no
    name can end the <script> that holds it."""
    alt: str
    """The figure in a few words, for readers who cannot see it."""
    note: str
    """What the figure leaves out, for the end of its caption."""


def text(name: str) -> str:
    """The name of a photo for plotly, whose texts may hold a few HTML tags."""
    return html.escape(shown_name(name))


def count(n: int) -> str:
    """A number with thin spaces between thousands."""
    return f"{n:,}".replace(",", "\u202f")


def figures3(value: float) -> str:
    """A number with three significant figures, never as a power of ten."""
    return np.format_float_positional(value, precision=3, fractional=False, trim="-")


def short(names: list[str]) -> list[str]:
    """The names without the folder that they share."""
    shared = names[0].rpartition("/")[0] + "/" if names else ""
    if shared != "/" and all(name.startswith(shared) for name in names):
        return [name.removeprefix(shared) for name in names]
    return names


def duration(seconds: float) -> str:
    """A time in its two largest units."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def figure(
    data: Sequence[BaseTraceType], layout: Mapping[str, object], *, alt: str, note: str = ""
) -> Figure:
    """A figure. The page gives it the colours of ground, text and grid."""
    base = {
        "template": go.layout.Template(),
        "margin": {"l": 60, "r": 16, "t": 12, "b": 50},
        "legend": {"orientation": "h", "yanchor": "bottom", "y": 1.01, "x": 0},
        "hoverlabel": {"namelength": -1},
    }
    made = go.Figure(data=list(data), layout={**base, **layout})
    spec = made.to_json()
    assert spec is not None
    return Figure(spec, alt, note)
