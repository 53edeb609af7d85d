"""Which settings each variant changes."""

import pytest

from perception.slam.ablations import VARIANTS, variant_config
from perception.slam.config import SlamConfig


def weighted_by_variance(config):
    return (
        config.fit.noise.rendered_variance,
        config.tracking.use_uncertainty,
        config.bundle_adjustment.noise.rendered_variance,
    )


@pytest.mark.parametrize(
    ("variant", "plane", "joint", "uncertainty"),
    [
        ("full", False, True, True),
        ("no_joint", False, False, True),
        ("no_uncertainty", False, True, False),
        ("with_plane", True, True, True),
    ],
)
def test_variants(variant, plane, joint, uncertainty):
    config = variant_config(variant)
    assert config.tracking.use_plane == plane == config.bundle_adjustment.use_plane
    assert config.use_bundle_adjustment == joint
    assert weighted_by_variance(config) == (uncertainty,) * 3


def test_all_variants_are_listed():
    assert VARIANTS == ("full", "no_joint", "no_uncertainty", "with_plane")


def test_variants_keep_the_other_settings_of_their_base():
    base = SlamConfig(use_bundle_adjustment=True, pose_check=SlamConfig().pose_check)
    for variant in VARIANTS:
        config = variant_config(variant, base)
        assert config.lifecycle is base.lifecycle and config.pose_check is base.pose_check
    assert variant_config("with_plane", base) is base
