"""One small network, written in every format."""

from pathlib import Path

import pytest
from imitations import SMALL, WRITERS, Layers, random_layers

from jaxsfm.weights_conversion.convert import read_source
from jaxsfm.weights_conversion.source import Source


@pytest.fixture(scope="session")
def layers() -> Layers:
    return random_layers()


@pytest.fixture(scope="session")
def files(layers, tmp_path_factory) -> dict[str, Path]:
    """The files by format; tests must not write to them."""
    folder = tmp_path_factory.mktemp("sources")
    return {name: writer(folder, layers) for name, writer in WRITERS.items()}


@pytest.fixture(scope="session")
def sources(files) -> dict[str, Source]:
    """The sources that are read from the files, by format."""
    return {name: read_source(file, shapes=SMALL) for name, file in files.items()}


@pytest.fixture
def small_head(monkeypatch):
    """NetVLAD's head with few numbers: 32 channels, 4 clusters, 8 dimensions after whitening."""
    from jaxsfm.io.weight_files import EXTRAS

    for name, shape in {
        "netvlad.assignment": (32, 4),
        "netvlad.centres": (32, 4),
        "netvlad.whitening": (128, 8),
        "netvlad.whitening_bias": (8,),
    }.items():
        monkeypatch.setitem(EXTRAS, name, shape)
