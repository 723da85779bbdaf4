"""Models of one run that share photos, joined to larger ones.

COLMAP's mapper starts a new model where it can add no photo, and lets up to twenty photos be in two
models. Models that were told apart share photos, too. Photos that two models share, and points that
both have there, say how one model lies in the other. Unlike new matches, they were not taken for
something else: each model rests on them. A join is kept only if no photos contradict each other in
it.
"""

import itertools
import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.colmap.model_images import registered
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.checker import CheckedModel, Checker
from jaxsfm.sfm.model_join import (
    ERROR_PX,
    JOIN_ERROR_PX,
    MIN_SHARED,
    adjusted,
    find_join,
    joined,
)

if TYPE_CHECKING:
    import pycolmap

MIN_OBSERVATIONS = 30
"""A photo that sees fewer points has no sure place: COLMAP registers none with fewer inliers."""

logger = logging.getLogger("jaxsfm")


class Joiner(NamedTuple):
    """Joins models that were made from one database."""

    checker: Checker
    options: MapOptions
    finished: "Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction]"
    """Gives a joined model the points that the models of the run have."""

    def join(self, models: Sequence[CheckedModel]) -> list[CheckedModel]:
        """Join models that share photos, those first that share most.

        Only models are joined that were checked and in which no photos contradict each other. A
        model whose photos are all in a larger one is left out.

        Returns:
          the models, the one with most photos first; the same ones if nothing was joined.
        """
        left, refused = list(models), set()
        while True:
            names = [frozenset(registered(model)) for model, _ in left]
            open_to = [
                (i, j)
                for i, j in itertools.combinations(range(len(left)), 2)
                if len(names[i] & names[j]) >= MIN_SHARED
                and {names[i], names[j]} not in refused
                and all(_agrees(left[k][1]) for k in (i, j))
            ]
            if not open_to:
                return left
            i, j = max(open_to, key=lambda pair: len(names[pair[0]] & names[pair[1]]))
            both = left[i] if names[j] <= names[i] else self._joined(left[i][0], left[j][0])
            if both is None:
                refused.add(frozenset((names[i], names[j])))
                continue
            logger.info("models of %d and %d photos were joined", len(names[i]), len(names[j]))
            left = [both, *(each for k, each in enumerate(left) if k not in (i, j))]
            left.sort(key=lambda each: -each[0].num_reg_images())

    def _joined(
        self, first: "pycolmap.Reconstruction", second: "pycolmap.Reconstruction"
    ) -> CheckedModel | None:
        """The two models as one; None if they do not agree."""
        a, b = (Model.from_colmap(each, stored_sizes(each)) for each in (first, second))
        join = find_join(a, b, error_px=JOIN_ERROR_PX * self.options.scale)
        if join.agreed < join.needed:
            return None
        own = {view.camera.camera_id: view.camera for view in a.views}
        theirs = {view.camera.camera_id: view.camera for view in b.views}
        both = adjusted(
            joined(a, b, join, {**theirs, **own}),
            error_px=ERROR_PX * self.options.scale,
            refine_intrinsics=self.options.refine_intrinsics,
            threads=self.options.threads,
        )
        if _loses_observations(both, first, second):
            return None
        (done,) = self.checker.check([both], ())
        return (self.finished(both), done) if _agrees(done) else None


def _loses_observations(
    both: "pycolmap.Reconstruction",
    first: "pycolmap.Reconstruction",
    second: "pycolmap.Reconstruction",
) -> bool:
    """Whether a photo that had `MIN_OBSERVATIONS` before does not have them in the joined model."""

    def seen(model: "pycolmap.Reconstruction") -> set[str]:
        images = (model.image(i) for i in model.reg_image_ids())
        return {image.name for image in images if image.num_points3D >= MIN_OBSERVATIONS}

    return not seen(first) | seen(second) <= seen(both)


def _agrees(done: Checked | None) -> bool:
    """Whether a model was checked and no photos contradict each other in it."""
    return done is not None and not done.check.contradictions
