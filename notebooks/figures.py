"""The figures of docs/how-it-works.md, taken from the notebooks as stored (tests execute them).

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
"""Name -> notebook, and which of its figures."""


def stored_figures(notebook: str) -> list[bytes]:
    """JPEG files of a notebook's figures, in order."""
    cells = json.loads((HERE / f"{notebook}.ipynb").read_text())["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    found = [
        output["data"]["image/jpeg"] for output in outputs if "image/jpeg" in output.get("data", {})
    ]
    return [base64.b64decode("".join(image)) for image in found]


def figures() -> dict[str, bytes]:
    """File name -> JPEG."""
    return {f"{name}.jpg": stored_figures(book)[k] for name, (book, k) in FIGURES.items()}


if __name__ == "__main__":
    for name, image in figures().items():
        (HERE.parent / "docs" / "images" / name).write_bytes(image)
