"""An adjusted model goes back to where it was before."""

import math
from typing import TYPE_CHECKING

import numpy as np

from jaxsfm.colmap.move_model import move_model
from jaxsfm.colmap.poses import Poses, model_poses
from jaxsfm.errors import UserError
from jaxsfm.sfm.evaluation import align

if TYPE_CHECKING:
    import pycolmap

STAYED, ROUNDS = 2 / 3, 10
"""The share of the cameras that say where the model lies, and how often it is chosen anew which.
The others moved most: their poses were wrong, and must not turn the model when they are
corrected."""


def move_back(model: "pycolmap.Reconstruction", before: Poses) -> None:
    """Move a model so that its cameras lie as they did before, in place. New cameras do not count.

    Bundle adjustment holds one camera, and the others turn about it. What else the user has in the
    frame of the given model, such as a mesh or a georeference, shall still fit. Cameras on one line
    do not say how the model lies; then it stays.
    """
    after = model_poses(model)
    names = sorted(after.keys() & before.keys())
    own = np.asarray([after[name].centre for name in names])
    wanted = np.asarray([before[name].centre for name in names])
    count = max(3, math.ceil(STAYED * len(names)))
    try:
        found = align(own, wanted)
        for _ in range(ROUNDS):
            at = found.scale * own @ found.rotation.T + found.translation
            nearest = np.argsort(np.linalg.norm(at - wanted, axis=1), kind="stable")[:count]
            found = align(own[nearest], wanted[nearest])
    except UserError:
        return
    move_model(model, found.scale, found.rotation, found.translation)
