"""The versions of the system that are compared (NodeSLAM, section "Ablation Study")."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

from perception.inference.ablations import method_config
from perception.slam.config import SlamConfig

Variant = Literal["full", "no_joint", "no_uncertainty", "with_plane"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)


def variant_config(variant: Variant, base: SlamConfig | None = None) -> SlamConfig:
    """The settings that a name stands for.

    full            objects alone hold the camera, as in the paper.
    no_joint        the same without joint optimisation: objects stay as they were initialised.
    no_uncertainty  the same with all pixels counting alike, whatever variance is rendered.
    with_plane      the product: the support plane is one more landmark.
    """
    base = base or SlamConfig()
    if variant == "with_plane":
        return base
    config = base.objects_only()
    if variant == "no_joint":
        return replace(config, joint_on=False)
    if variant == "no_uncertainty":
        return replace(
            config,
            fit=method_config("no_uncertainty", config.fit),
            tracking=replace(config.tracking, use_uncertainty=False),
            joint=replace(config.joint, noise=replace(config.joint.noise, rendered_variance=False)),
        )
    return config
