"""Runs of the mapper on a share of the matches, and the points of all matches afterwards.

Each run is kept as soon as it ends, because it may take hours.
"""

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxsfm.colmap.inliers import keep_inliers, read_inliers
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import (
    Attempt,
    Mapped,
    Start,
    first_models,
    run_mapper,
    with_left_out_images,
)
from jaxsfm.colmap.model_folders import read_models, write_models
from jaxsfm.colmap.triangulation import with_all_points
from jaxsfm.colmap.two_views import TwoView
from jaxsfm.io.hashes import rows_sha256
from jaxsfm.io.kept_folders import Steps
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.mapper_matches import mapper_matches
from jaxsfm.sfm.parts.map_parts import MANY, map_in_parts

if TYPE_CHECKING:
    import pycolmap

MODELS = "models"
"""The folder of the models of a kept run."""


class MapperRuns:
    """Maps the pairs of a database, which may change between two runs.

    If the models are refined afterwards, the mapper is given a share of the matches
    (`jaxsfm.sfm.mapper_matches`).
    """

    def __init__(
        self,
        database: Path,
        scratch: Path,
        options: MapOptions,
        *,
        share: bool,
        on_image: Callable[[], None] = lambda: None,
        steps: Steps | None = None,
    ) -> None:
        """
        Args:
          database: with the pairs to map.
          scratch: a folder for the database that the mapper is given.
          share: give the mapper a share of the matches, of which it makes a draft; otherwise all of
            them.
          on_image: called for every image that the mapper registers.
          steps: where the models of each run are kept; None: nowhere.
        """
        self._steps = steps
        self._database, self._options, self._on_image = database, options, on_image
        self._share, self._mapping = share, dataclasses.replace(options, draft=share)
        self._given = scratch / "mapper.db" if share else database
        self._whole: list[tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]] = []
        """Models, and what `with_all_points` gave for them."""
        self.attempts: list[Attempt] = []
        """All runs so far."""

    def database_changed(self) -> None:
        """Say that the database has other pairs than before."""
        self._whole.clear()

    def first(self) -> Mapped:
        """The models of one run of the mapper, or of runs for parts of many photos.

        If the models of the parts do not agree with each other, the mapper is given all photos.
        """
        chosen = None
        if self._share:
            shutil.copyfile(self._database, self._given)
            chosen = mapper_matches(read_inliers(self._given))
            keep_inliers(self._given, chosen)
        made = self._in_parts(chosen) if self._options.in_parts else None
        if made is None:
            made = first_models(
                self._given, self._mapping, on_image=self._on_image, run=self._kept_run
            )
        self.attempts += made.attempts
        return made

    def _in_parts(self, chosen: Mapping[Pair, np.ndarray] | None) -> Mapped | None:
        """The models of runs for parts; None for few photos, and if the models do not agree."""
        given = read_inliers(self._given).matches if chosen is None else chosen
        matches = {pair: len(rows) for pair, rows in given.items()}
        if len({name for pair in matches for name in pair}) <= MANY:
            return None
        return map_in_parts(
            self._given, matches, self._mapping, on_image=self._on_image, run=self._kept_run
        )

    def _kept_run(
        self, database: Path, options: MapOptions, start: Start, on_image: Callable[[], None]
    ) -> "list[pycolmap.Reconstruction]":
        """The models of a run of the mapper that may have been made before."""
        if self._steps is None:
            return run_mapper(database, options, start, on_image)
        about = [rows_sha256(database), dataclasses.asdict(options), start.pair, list(start.names)]
        ran = []

        def make(folder: Path) -> None:
            ran.append(True)
            write_models(run_mapper(database, options, start, on_image), folder / MODELS)

        folder = self._steps.kept("mapper", about, make)
        models = read_models(folder / MODELS, database)
        if not ran:
            for _ in range(sum(model.num_reg_images() for model in models)):
                on_image()
        return models

    def with_left_out_images(self, made: Mapped, two_views: Mapping[Pair, TwoView]) -> Mapped:
        """The models of further runs, if the first run since the database changed left out images.

        Args:
          made: the models of that run. They are returned if nothing was tried.
          two_views: the pairs in the database.
        """
        more = with_left_out_images(
            made,
            self._given,
            two_views,
            self._mapping,
            on_image=self._on_image,
            run=self._kept_run,
        )
        self.attempts += more.attempts[len(made.attempts) :]
        return more

    def as_mapped(self, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
        """A model that was joined from others, as the mapper would have left it.

        If the mapper is given all matches, their points are triangulated, and the model has
        COLMAP's numbers of keypoints. If it is given a share, the model stays as it is: the points
        of all matches return later.
        """
        return model if self._share else with_all_points(model, self._database, self._options)

    def with_all_points(
        self, model: "pycolmap.Reconstruction", *, final: bool = False
    ) -> "pycolmap.Reconstruction":
        """A model with the points of all matches of the pairs that are in the database now.

        The points are adjusted as those of a draft: the check asks only where they are missing, and
        a model is refined later. They are kept, because a model that is checked is often asked for
        again.

        Args:
          final: the model is not refined later, so the points are adjusted to the end.
        """
        if not self._share:
            return model
        if final:
            return with_all_points(model, self._database, self._options)
        for one, whole in self._whole:
            if one is model and one.num_reg_images() == whole.num_reg_images():
                return whole
        whole = with_all_points(model, self._database, self._mapping)
        self._whole.append((model, whole))
        return whole
