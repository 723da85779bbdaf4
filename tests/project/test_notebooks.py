"""Notebooks run, at their small size; as they are stored they were run in order and are small."""

import os
import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
NAMES = sorted(path.name for path in FOLDER.glob("*.ipynb"))
LEAST_IMAGES = 4
MOST_BYTES = 1_500_000
SECONDS = 600
"""Of one cell: a machine with other work to do compiles slowly."""
PRIVATE = re.compile(r"/(home|root|Users|tmp|work|var)/|[A-Z]:\\|Traceback|site-packages")
"""What a machine's own paths and failures look like."""

# Of Jupyter's own modules, which announce their own changes.
pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning:(jupyter_client|jupyter_core|nbclient|nbformat|traitlets|zmq)"
)


def read(name: str):
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(FOLDER / name, as_version=4)
    nbformat.validate(notebook)
    return notebook


def code(notebook) -> list:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def images(notebook) -> int:
    return sum(
        kind.startswith("image/")
        for cell in code(notebook)
        for output in cell.outputs
        for kind in output.get("data", {})
    )


def test_there_are_notebooks():
    assert NAMES


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.slow
def test_a_notebook_runs(name, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = read(name)
    for cell in code(notebook):
        cell.outputs, cell.execution_count = [], None
    monkeypatch.setenv("JAXSFM_NOTEBOOK_SIZE", "small")
    paths = [str(FOLDER.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))  # the kernel starts elsewhere
    for place in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR"):  # not the user's
        monkeypatch.setenv(place, str(tmp_path / place.lower()))
    client = nbclient.NotebookClient(
        notebook,
        timeout=SECONDS,
        kernel_name="python3",
        resources={"metadata": {"path": str(tmp_path)}},
    )
    client.execute()  # raises where a cell does
    assert [cell.execution_count for cell in code(notebook)] == list(
        range(1, len(code(notebook)) + 1)
    )
    assert images(notebook) >= LEAST_IMAGES


@pytest.mark.parametrize("name", NAMES)
def test_a_stored_notebook_was_run_in_order_and_is_small(name):
    notebook = read(name)
    counts = [cell.execution_count for cell in code(notebook)]
    assert counts == list(range(1, len(counts) + 1))
    assert images(notebook) >= LEAST_IMAGES
    assert (FOLDER / name).stat().st_size < MOST_BYTES


@pytest.mark.parametrize("name", NAMES)
def test_a_stored_notebook_tells_nothing_of_its_machine(name):
    notebook = read(name)
    assert set(notebook.metadata) <= {"kernelspec", "language_info"}
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in code(notebook):
        assert not cell.metadata
        for output in cell.outputs:
            assert output.output_type != "error" and output.get("name") != "stderr"
            shown = [output.get("text", ""), *output.get("data", {}).values()]
            texts = [text for text in shown if len(text) < 10_000]  # the others are images
            assert not any(PRIVATE.search(text) for text in texts)
