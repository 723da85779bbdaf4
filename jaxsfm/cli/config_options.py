"""The options that choose a `Config`: a preset, and single settings that differ from it."""

import dataclasses
from pathlib import Path
from typing import Literal

from jaxsfm.config import BackboneName, Config, Convolutions, Keypoints, Refinement, preset
from jaxsfm.errors import UserError

Preset = Literal["paper", "default", "robust"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchingChoice:
    """What is computed for an image and for a pair.

    Attributes:
      preset: paper: the constants of the authors' code. default: octaves, centred descriptors and
        neighbourhood consensus (for night, seasons and weather), better planes, a view graph and
        two passes of refinement. robust: as default, and photos smaller than max-size are enlarged
        up to twice.
      max_size: Longer side of the working images, pixels.
      keypoints: relocalized: a keypoint moves to the largest norms of the features, the paper's
        rule. learned: it moves to the largest learned scores. grid: it stays in the centre of its
        cell (for ablations). preset: as the preset says.
      backbone: The network: vgg16, which the paper uses; alexnet; or vgg19, which needs --weights.
      convolutions: Number format that the network multiplies in; bfloat16 is meant for
        accelerators.
    """

    preset: Preset = "default"
    max_size: int = 1600
    keypoints: Keypoints | Literal["preset"] = "preset"
    backbone: BackboneName = "vgg16"
    convolutions: Convolutions = "float32"

    def config(self, relocalizer: Path | None = None) -> Config:
        """The preset with the settings that differ from it.

        Args:
          relocalizer: file of learned scores; if there is one, keypoints are learned.

        Raises:
          UserError: a setting that cannot be, or settings that contradict each other.
        """
        try:
            return self._config(relocalizer)
        except ValueError as error:
            raise UserError(f"--{str(error).replace('_', '-', 1)}") from error

    def _config(self, relocalizer: Path | None) -> Config:
        config = dataclasses.replace(
            preset(self.preset),
            max_size=self.max_size,
            convolutions=self.convolutions,
            backbone=self.backbone,
        )
        keypoints = self.keypoints
        if relocalizer is not None:
            if keypoints not in ("preset", "learned"):
                raise ValueError(
                    f"relocalizer {relocalizer} needs learned keypoints; got {keypoints}"
                )
            keypoints = "learned"
        if keypoints != "preset":
            config = dataclasses.replace(config, keypoints=keypoints)
        return config


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelChoice(MatchingChoice):
    """What is computed for an image, for a pair and for the model.

    Attributes:
      view_graph: Whether only those pairs are mapped whose rotations agree with stronger pairs
        (for scenes with repeated structure).
      refine: Passes of multi-view keypoint refinement; 0: none; default: as the preset says.
    """

    view_graph: Literal["preset", "yes", "no"] = "preset"
    refine: int | None = None

    def _config(self, relocalizer: Path | None) -> Config:
        config = super()._config(relocalizer)
        if self.view_graph != "preset":
            config = dataclasses.replace(config, view_graph=self.view_graph == "yes")
        if self.refine is not None:
            if self.refine < 0:
                raise ValueError(f"refine must be at least 0; got {self.refine}")
            passes = Refinement(passes=self.refine) if self.refine else None
            config = dataclasses.replace(config, refinement=passes)
        return config
