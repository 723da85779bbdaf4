"""Takes the figures of docs/how-it-works.md from the stored notebooks, which the tests execute.

python notebooks/figures.py
"""

import base64
import json
from pathlib import Path

HERE = Path(__file__).parent
FIGURES = {
    "norms": ("01_features", 0),
    "octaves": ("01_features", 4),
    "coarse": ("02_match_and_relocalize", 0),
    "fine": ("02_match_and_relocalize", 1),
    "walk": ("02_match_and_relocalize", 2),
    "planes": ("02_match_and_relocalize", 5),
    "view_graph": ("03_reconstruct", 1),
    "refinement": ("03_reconstruct", 4),
}
"""The notebook of each figure, and the number of the figure in it."""


def stored_figures(notebook: str) -> list[bytes]:
    """The contents of a notebook's figures as JPEG files, in order."""
    cells = json.loads((HERE / f"{notebook}.ipynb").read_text())["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    found = [
        output["data"]["image/jpeg"] for output in outputs if "image/jpeg" in output.get("data", {})
    ]
    return [base64.b64decode("".join(image)) for image in found]


def figures() -> dict[str, bytes]:
    """The contents of the JPEG files, by file name."""
    return {f"{name}.jpg": stored_figures(book)[k] for name, (book, k) in FIGURES.items()}


if __name__ == "__main__":
    for name, image in figures().items():
        (HERE.parent / "docs" / "images" / name).write_bytes(image)
