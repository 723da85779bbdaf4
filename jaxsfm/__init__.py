"""Structure-from-Motion from dense VGG-16 features with keypoint relocalization, in JAX.

The public names below are loaded on first use: `import jaxsfm.core` needs jax and flax alone.
"""

import importlib
import zlib  # noqa: F401  before anyone loads pycolmap, whose own zlib else corrupts deflate
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from jaxsfm.colmap.cameras import Cameras as Cameras
    from jaxsfm.colmap.given_cameras import parse_intrinsics as parse_intrinsics
    from jaxsfm.colmap.map_options import MapOptions as MapOptions
    from jaxsfm.colmap.poses import model_poses as model_poses
    from jaxsfm.colmap.poses import read_poses as read_poses
    from jaxsfm.config import Config as Config
    from jaxsfm.config import PairShape as PairShape
    from jaxsfm.config import preset as preset
    from jaxsfm.errors import UserError as UserError
    from jaxsfm.io.pairs import PairResult as PairResult
    from jaxsfm.io.pairs import best_pairs as best_pairs
    from jaxsfm.io.pairs import exhaustive_pairs as exhaustive_pairs
    from jaxsfm.io.weights import Weights as Weights
    from jaxsfm.io.weights import load_weights as load_weights
    from jaxsfm.matching.execution import Execution as Execution
    from jaxsfm.matching.pipeline import extract as extract
    from jaxsfm.matching.pipeline import match as match
    from jaxsfm.matching.pipeline import open_images as open_images
    from jaxsfm.matching.retrieval import shortlist as shortlist
    from jaxsfm.runs.reconstruct import run_folder as run_folder
    from jaxsfm.runs.run_options import RunOptions as RunOptions
    from jaxsfm.sfm.evaluation import Evaluation as Evaluation
    from jaxsfm.sfm.evaluation import evaluate as evaluate
    from jaxsfm.sfm.refine.pair_alignment import align as align
    from jaxsfm.sfm.road import reconstruct as reconstruct
    from jaxsfm.sfm.two_photos.pair_passes import match_photos as match_photos

_HOME = {
    "Config": "config",
    "PairShape": "config",
    "preset": "config",
    "UserError": "errors",
    "Evaluation": "sfm.evaluation",
    "evaluate": "sfm.evaluation",
    "Execution": "matching.execution",
    "Cameras": "colmap.cameras",
    "MapOptions": "colmap.mapper",
    "parse_intrinsics": "colmap.given_cameras",
    "PairResult": "io.pairs",
    "best_pairs": "io.pairs",
    "exhaustive_pairs": "io.pairs",
    "model_poses": "colmap.poses",
    "read_poses": "colmap.poses",
    "Weights": "io.weights",
    "load_weights": "io.weights",
    "align": "sfm.refine.pair_alignment",
    "extract": "matching.pipeline",
    "match": "matching.pipeline",
    "match_photos": "sfm.two_photos.pair_passes",
    "open_images": "matching.pipeline",
    "reconstruct": "sfm.road",
    "RunOptions": "runs.run_options",
    "shortlist": "matching.retrieval",
    "run_folder": "runs.reconstruct",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from jaxsfm.io.libraries import package_versions  # asks the installation; loads no package

        return package_versions()["jaxsfm"]
    if name not in _HOME:
        raise AttributeError(f"module 'jaxsfm' has no attribute {name!r}")
    module = importlib.import_module(f"jaxsfm.{_HOME[name]}")
    return getattr(module, name)


def __dir__() -> list[str]:
    return sorted(_HOME)
