"""The ways to reconstruct an object that are compared: ours, ours without one of its parts, and others'.

Each name stands for a configuration of the same fit, but for TSDF fusion, which knows no shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

from perception.fusion.tsdf import TsdfConfig, reconstruct_tsdf
from perception.inference.fit import FitConfig
from perception.inference.reconstruct import reconstruct
from perception.inference.shape_model import Decoder
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

Method = Literal["full", "no_refinement", "no_uncertainty", "no_pyramid", "dvr", "mask_only", "tsdf"]
METHODS: tuple[Method, ...] = get_args(Method)


def method_config(method: Method, base: FitConfig | None = None) -> FitConfig:
    """The fit that a method's name stands for, all else as in ``base``.

    - ``full``: the default configuration.
    - ``no_refinement``: the decoded surface, as in the paper; the mesh is not moved onto the measurements.
    - ``no_uncertainty``: equal pixel weights instead of the rendered variance.
    - ``no_pyramid``: the crop and the level of the last stage from the first iteration on.
    - ``dvr``: depth of the first crossing of the occupancy level (Niemeyer et al., CVPR 2020), which has no
      variance for the weights; without refinement.
    - ``mask_only``: the rendered mask against the detected one; depth is used for initialisation only; without
      refinement.
    - ``tsdf``: TSDF fusion of the views: an open surface.

    Raises:
        ValueError: TSDF fusion is no fit.
    """
    base = base or FitConfig()
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
    raise ValueError(f"{method} is no configuration of the fit")


def reconstruct_by(
    method: Method,
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig | None = None,
    workers: int | None = None,
) -> list[ObjectEstimate]:
    """Reconstructs every instance by a method; arguments as in ``reconstruct``.

    Raises:
        FusionUnavailableError: TSDF fusion without open3d.
    """
    if method == "tsdf":
        return reconstruct_tsdf(frames, detections_per_frame, plane, TsdfConfig(closed=False))
    return reconstruct(
        frames, detections_per_frame, decoder, plane, method_config(method, config), workers=workers
    )
