"""Stages of a reconstruction, whose files may exist from an earlier run."""

import contextlib
import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple, Protocol

logger = logging.getLogger("jaxsfm")


class StageStore(Protocol):
    """A place for the files of finished stages (`jaxsfm.io.work_folder.WorkFolder`)."""

    def stage(self, name: str, key: str) -> Path | None: ...

    def record_stage(self, name: str, key: str) -> AbstractContextManager[Path]: ...

    def stage_folder(self, name: str) -> Path: ...

    def forget_stage(self, name: str) -> None: ...


class StageCache(NamedTuple):
    """Stages of earlier runs, and what tells whether they still hold."""

    store: StageStore
    matches_key: str
    """Identifies the matches. A stage is used again only for the same matches."""


class TemporaryStages:
    """A store that starts empty, in a folder that the caller deletes."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)

    def stage(self, name: str, key: str) -> Path | None:
        return None

    @contextlib.contextmanager
    def record_stage(self, name: str, key: str) -> Iterator[Path]:
        folder = self.stage_folder(name)
        folder.mkdir()
        yield folder

    def stage_folder(self, name: str) -> Path:
        return self._folder / name

    def forget_stage(self, name: str) -> None:
        pass


def run_stage(store: StageStore, name: str, key: str, compute: Callable[[Path], None]) -> Path:
    """The folder with the files of a stage. The stage runs only if `store` does not have it.

    Args:
      key: identifies everything that the stage depends on.
      compute: runs the stage and writes its files into the given folder.
    """
    folder = store.stage(name, key)
    if folder is not None:
        logger.info("%s: as before, nothing it depends on has changed", name)
        return folder
    with store.record_stage(name, key) as fresh:
        compute(fresh)
    return store.stage_folder(name)
