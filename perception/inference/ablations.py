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

    full            the product.
    no_refinement   the decoded shape as it is, as in the paper: no vertex moves to the measurements.
    no_uncertainty  every pixel counts alike, whatever variance is rendered.
    no_pyramid      the last stage's crop and level from the first iteration on.
    dvr             depth of the first crossing of the occupancy level (Niemeyer et al., CVPR 2020). It has no
                    variance to weigh with. Not refined either, being another's.
    mask_only       the rendered mask against the detected one; depth only finds the start. Not refined.
    tsdf            what the views show, fused, and nothing else: an open surface.

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
