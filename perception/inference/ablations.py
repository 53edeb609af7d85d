"""Methods compared in the evaluation: the product, the product without one of its parts, and baselines.

Each name stands for a configuration of the same fit, except for TSDF fusion, which has no shape prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

from perception.fusion.tsdf import TsdfConfig, reconstruct_tsdf
from perception.inference.fit_config import FitConfig
from perception.inference.reconstruct import ReconstructOptions, reconstruct
from perception.inference.shape_model import Decoder
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

Method = Literal["full", "no_refinement", "no_uncertainty", "no_pyramid", "dvr", "mask_only", "tsdf"]
METHODS: tuple[Method, ...] = get_args(Method)


def method_config(method: Method, base: FitConfig = FitConfig()) -> FitConfig:
    """Return the configuration of a method, otherwise as ``base``.

    - ``full``: the default configuration.
    - ``no_refinement``: the decoded surface, as in the paper; the mesh is not moved onto the measurements.
    - ``no_uncertainty``: equal pixel weights instead of the rendered variance.
    - ``no_pyramid``: the crop and the level of the last stage from the first iteration on.
    - ``dvr``: depth of the first crossing of the occupancy level (Niemeyer et al., CVPR 2020), which has no
      variance for the weights; without refinement.
    - ``mask_only``: the rendered mask against the detected one; depth is used for initialisation
      only; without refinement.
    - ``tsdf``: TSDF fusion of the views: an open surface.

    Raises:
        ValueError: TSDF fusion is not a configuration of the fit.
    """
    match method:
        case "full":
            return base
        case "no_refinement":
            return replace(base, refine=None)
        case "no_uncertainty":
            return replace(base, noise=replace(base.noise, rendered_variance=False))
        case "no_pyramid":
            last = base.stages[-1]
            return replace(base, stages=tuple(replace(last, iterations=s.iterations) for s in base.stages))
        case "dvr":
            return replace(base, renderer="first_crossing", refine=None)
        case "mask_only":
            return replace(base, renderer="silhouette", refine=None)
    raise ValueError(f"{method} is not a configuration of the fit")


def reconstruct_by(
    method: Method,
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig = FitConfig(),
) -> list[ObjectEstimate]:
    """Reconstruct every instance by one method on one core; arguments as for ``reconstruct``.

    Raises:
        FusionUnavailableError: TSDF fusion without open3d.
    """
    if method == "tsdf":
        return reconstruct_tsdf(frames, detections_per_frame, plane, TsdfConfig(closed=False))
    one_core = ReconstructOptions(workers=1)
    return reconstruct(frames, detections_per_frame, decoder, plane, method_config(method, config), one_core)
