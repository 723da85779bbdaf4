"""Structure-from-Motion from dense VGG-16 features with keypoint relocalization, in JAX.

The public names below are loaded on first use: `import jaxsfm.core` needs jax and flax alone.
"""

import importlib
import zlib  # noqa: F401  before anyone loads pycolmap, whose own zlib else corrupts deflate
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxsfm.config import Config as Config
    from jaxsfm.config import PairShape as PairShape
    from jaxsfm.config import preset as preset
    from jaxsfm.errors import UserError as UserError
    from jaxsfm.evaluation import Evaluation as Evaluation
    from jaxsfm.evaluation import evaluate as evaluate
    from jaxsfm.execution import Execution as Execution
    from jaxsfm.host.intrinsics import parse_intrinsics as parse_intrinsics
    from jaxsfm.host.mapping import MapOptions as MapOptions
    from jaxsfm.host.pairs import PairResult as PairResult
    from jaxsfm.host.pairs import best_pairs as best_pairs
    from jaxsfm.host.pairs import exhaustive_pairs as exhaustive_pairs
    from jaxsfm.host.poses import model_poses as model_poses
    from jaxsfm.host.poses import read_poses as read_poses
    from jaxsfm.host.weights import Weights as Weights
    from jaxsfm.host.weights import load_weights as load_weights
    from jaxsfm.pair_alignment import align as align
    from jaxsfm.pipeline import extract as extract
    from jaxsfm.pipeline import match as match
    from jaxsfm.pipeline import open_images as open_images
    from jaxsfm.reconstruction import reconstruct as reconstruct
    from jaxsfm.retrieval import shortlist as shortlist
    from jaxsfm.run import run_folder as run_folder
    from jaxsfm.run_options import RunOptions as RunOptions

_HOME = {
    "Config": "config",
    "PairShape": "config",
    "preset": "config",
    "UserError": "errors",
    "Evaluation": "evaluation",
    "evaluate": "evaluation",
    "Execution": "execution",
    "MapOptions": "host.mapping",
    "parse_intrinsics": "host.intrinsics",
    "PairResult": "host.pairs",
    "best_pairs": "host.pairs",
    "exhaustive_pairs": "host.pairs",
    "model_poses": "host.poses",
    "read_poses": "host.poses",
    "Weights": "host.weights",
    "load_weights": "host.weights",
    "align": "pair_alignment",
    "extract": "pipeline",
    "match": "pipeline",
    "open_images": "pipeline",
    "reconstruct": "reconstruction",
    "RunOptions": "run_options",
    "shortlist": "retrieval",
    "run_folder": "run",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxsfm' has no attribute {name!r}")
    module = importlib.import_module(f"jaxsfm.{_HOME[name]}")
    return getattr(module, name)


def __dir__() -> list[str]:
    return sorted(_HOME)
