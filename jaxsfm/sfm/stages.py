"""Stages whose files may be there from an earlier run."""

import contextlib
import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple, Protocol

logger = logging.getLogger("jaxsfm")


class Stages(Protocol):
    """Where finished stages are kept (`jaxsfm.io.work_folder.WorkFolder`)."""

    def stage(self, name: str, key: str) -> Path | None: ...

    def record_stage(self, name: str, key: str) -> AbstractContextManager[Path]: ...

    def stage_folder(self, name: str) -> Path: ...

    def forget_stage(self, name: str) -> None: ...


class Kept(NamedTuple):
    """Stages that may be there already."""

    stages: Stages
    matches_key: str
    """Of all that the matches are made of."""


class InScratch:
    """Stages that nothing is kept of."""

    def __init__(self, scratch: str) -> None:
        self._scratch = Path(scratch)

    def stage(self, name: str, key: str) -> Path | None:
        return None

    @contextlib.contextmanager
    def record_stage(self, name: str, key: str) -> Iterator[Path]:
        folder = self.stage_folder(name)
        folder.mkdir()
        yield folder

    def stage_folder(self, name: str) -> Path:
        return self._scratch / name

    def forget_stage(self, name: str) -> None:
        pass


def made(stages: Stages, name: str, key: str, make: Callable[[Path], None]) -> Path:
    """The folder of a stage, made if it is not there."""
    folder = stages.stage(name, key)
    if folder is not None:
        logger.info("%s: as before, nothing it depends on has changed", name)
        return folder
    with stages.record_stage(name, key) as fresh:
        make(fresh)
    return stages.stage_folder(name)
