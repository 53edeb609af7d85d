"""Sizes of the detection networks' layers, and their parameters for inference.

For inference each batch normalisation is folded into the convolution before it, which then has a bias.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from perception.detection import crops, working_view
from perception.detection.tasks import ENSEMBLE_SIZE, OUTPUTS, SCENE_OUTPUTS, Task


@dataclass(frozen=True)
class CropSizes:
    """Sizes of the networks on crops.

    Attributes:
        widths: Channels of the convolution stages, each of stride two.
        squeezed: Channels of the 1 x 1 bottleneck.
        hidden: Outputs of the first linear layer.
    """

    widths: tuple[int, ...]
    squeezed: int
    hidden: int


CROP_SIZES = CropSizes((32, 64, 128, 192), 64, 192)

SCENE_WIDTHS = (24, 48, 80, 128, 160)
SCENE_JOINED = (32, 48, 64)  # channels of the decoder, fine to coarse
SCENE_RESIDUALS = (0, 0, 2, 2, 1)  # residual blocks of each stage of the encoder

Shapes = dict[str, tuple[int, ...]]

_EPSILON = 1e-5  # of batch normalisation


def crop_shapes(task: Task) -> Shapes:
    """Return the shapes of a crop network's parameters by name, with folded batch normalisations."""
    members = ENSEMBLE_SIZE[task]
    prefixes = [""] if members == 1 else [f"members.{member}." for member in range(members)]
    return {
        prefix + name: shape for prefix in prefixes for name, shape in _crop_shapes(OUTPUTS[task]).items()
    }


def scene_shapes() -> Shapes:
    """Return the shapes of the scene network's parameters by name, with folded batch normalisations."""
    shapes = _convolution("down.0.0", 4 * working_view.CHANNELS, SCENE_WIDTHS[0], 3)
    for stage, (narrow, wide) in enumerate(pairwise(SCENE_WIDTHS), start=1):
        shapes |= _convolution(f"down.{stage}.0.0", narrow, wide, 3)
        residuals = SCENE_RESIDUALS[stage]
        if not residuals:
            shapes |= _convolution(f"down.{stage}.1.0", wide, wide, 3)
        for block in range(1, 1 + residuals):
            shapes |= _convolution(f"down.{stage}.{block}.first.0", wide, wide, 3)
            shapes |= _convolution(f"down.{stage}.{block}.second.0", wide, wide, 3)
    fine, middle, coarse = SCENE_JOINED
    for level, narrow in enumerate((fine, middle, coarse, coarse, coarse)):
        shapes |= _convolution(f"across.{level}.0", SCENE_WIDTHS[level], narrow, 1)
    shapes |= _convolution("narrower.0", middle, fine, 1) | _convolution("narrower.1", coarse, middle, 1)
    for level, width in enumerate(SCENE_JOINED):
        shapes |= _convolution(f"joined.{level}.0", width, width, 3)
    return shapes | _convolution("answer", fine, SCENE_OUTPUTS, 1)


def fold_normalisations(tensors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the parameters in float32 with each batch normalisation folded into its convolution.

    Layer ``<block>.1`` is the normalisation of the convolution ``<block>.0``; other tensors are kept.
    """
    folded: dict[str, np.ndarray] = {name: np.asarray(v, np.float32) for name, v in tensors.items()}
    for block in [
        name.removesuffix(".1.running_mean") for name in tensors if name.endswith(".1.running_mean")
    ]:
        parts = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
        gamma, beta, mean, variance, _ = (folded.pop(f"{block}.1.{part}", None) for part in parts)
        weight = folded.get(f"{block}.0.weight")
        if weight is None or gamma is None or beta is None or mean is None or variance is None:
            continue  # of another network; its shapes are checked afterwards
        if not gamma.shape == beta.shape == mean.shape == variance.shape == weight.shape[:1]:
            continue
        factor = gamma / np.sqrt(variance + np.float32(_EPSILON))
        folded[f"{block}.0.weight"] = weight * factor.reshape(-1, *(1,) * (weight.ndim - 1))
        folded[f"{block}.0.bias"] = beta - mean * factor
    return folded


def _crop_shapes(outputs: int) -> Shapes:
    sizes = CROP_SIZES
    shapes = _convolution("features.0.0", crops.CHANNELS, sizes.widths[0], 3)
    layer = 1
    for narrow, wide in pairwise(sizes.widths):
        shapes |= _convolution(f"features.{layer}.0", narrow, wide, 3)
        shapes |= _convolution(f"features.{layer + 1}.0", wide, wide, 3)
        layer += 2
    shapes |= _convolution(f"features.{layer}.0", sizes.widths[-1], sizes.squeezed, 1)
    flat = sizes.squeezed * (crops.SIDE // 2 ** len(sizes.widths)) ** 2
    shapes |= {"head.0.weight": (sizes.hidden, flat + crops.CONTEXT), "head.0.bias": (sizes.hidden,)}
    return shapes | {"logits.weight": (outputs, sizes.hidden), "logits.bias": (outputs,)}


def _convolution(name: str, inputs: int, outputs: int, side: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs, side, side), f"{name}.bias": (outputs,)}
