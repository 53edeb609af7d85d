"""Ablations of the SLAM system (NodeSLAM, section "Ablation Study")."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

from perception.inference.ablations import method_config
from perception.slam.config import SlamConfig

Variant = Literal["full", "no_joint", "no_uncertainty", "with_plane"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)


def variant_config(variant: Variant, base: SlamConfig | None = None) -> SlamConfig:
    """Return the settings of a variant.

    full            Object landmarks alone constrain the camera, as in the paper.
    no_joint        As full, without joint optimisation: objects stay as initialised.
    no_uncertainty  As full, with equal weights for all pixels: the rendered variance is ignored.
    with_plane      The default system: the support plane is one more landmark.

    Args:
        variant: Name of the variant.
        base: Settings that the variant modifies; the defaults if None.
    """
    base = base or SlamConfig()
    if variant == "with_plane":
        return base
    config = base.objects_only()
    if variant == "no_joint":
        return replace(config, use_bundle_adjustment=False)
    if variant == "no_uncertainty":
        noise = replace(config.bundle_adjustment.noise, rendered_variance=False)
        return replace(
            config,
            fit=method_config("no_uncertainty", config.fit),
            tracking=replace(config.tracking, use_uncertainty=False),
            bundle_adjustment=replace(config.bundle_adjustment, noise=noise),
        )
    return config
