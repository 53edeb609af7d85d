"""Yaw distributions: labels, rotation to the world, fusion, modes."""

import numpy as np
import pytest

from perception.detection.geometry import heading_angle, view_heading
from perception.detection.yaw import YAW_BINS, bin_centres, entropy, fuse_yaws, modes, rotate_yaw, soft_labels
from perception.types import SupportPlane

PLANE = SupportPlane()


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi, -2.0])
@pytest.mark.parametrize("azimuth", [0, 70, 200, 315])
def test_yaw_relative_to_the_view_becomes_world_yaw(scenes, yaw, azimuth):
    """Geometric round trip: an arrow at the object's yaw, its angle measured against the heading alone."""
    frame = scenes.render([], scenes.orbit((0.45, -0.2, 0.05), 0.5, 55, azimuth)).frame
    point = np.array([0.45, -0.2, 0.05])
    heading = view_heading(frame, PLANE, point)
    arrow = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    relative = np.arctan2(np.cross(heading, arrow) @ PLANE.normal, heading @ arrow)
    world = rotate_yaw(soft_labels(np.array([relative]))[0], heading_angle(heading, PLANE))
    (found, _), *_ = modes(world)
    assert abs((found - yaw + np.pi) % (2 * np.pi) - np.pi) < np.radians(1.0)


def test_soft_labels_are_centred_distributions():
    labels = soft_labels(np.array([0.0, 3.0, -0.3]))
    assert labels.sum(1) == pytest.approx(1.0)
    mean = np.angle(labels @ np.exp(1j * bin_centres()))
    assert mean == pytest.approx([0.0, 3.0, -0.3], abs=1e-3)


def test_turning_by_whole_bins_rolls():
    p = soft_labels(np.array([1.0]))[0]
    assert rotate_yaw(p, 5 * 2 * np.pi / YAW_BINS) == pytest.approx(np.roll(p, 5))
    assert rotate_yaw(p, 0.123).sum() == pytest.approx(1.0)


def test_fusion_sharpens_agreement_and_survives_one_confident_mistake():
    right = soft_labels(np.array([1.0]), spread=0.3)[0]
    wrong = soft_labels(np.array([-2.0]), spread=0.05)[0]
    assert entropy(fuse_yaws([right, right])) < entropy(right)
    (yaw, _), *_ = modes(fuse_yaws([right, right, right, wrong]))
    assert yaw == pytest.approx(1.0, abs=0.05)


def test_modes_list_both_of_two_candidates():
    both = 0.7 * soft_labels(np.array([0.5]))[0] + 0.3 * soft_labels(np.array([3.6]))[0]
    (first, heavy), (second, light) = modes(both)
    assert (first, second) == pytest.approx((0.5, 3.6), abs=0.03)
    assert heavy > light
    assert len(modes(np.full(YAW_BINS, 1 / YAW_BINS))) == 1


def test_rotation_adds_the_angle_and_interpolates():
    p = np.zeros(YAW_BINS)
    p[3] = 1.0
    width = 2 * np.pi / YAW_BINS
    assert rotate_yaw(p, 2 * width).argmax() == 5
    half = rotate_yaw(p, 0.25 * width)
    assert half[3] == pytest.approx(0.75) and half[4] == pytest.approx(0.25)


def test_fusion_is_the_product_of_mixtures_with_a_uniform_share():
    a, b = np.array([0.7, 0.3]), np.array([0.2, 0.8])
    mixed = (0.95 * a + 0.025) * (0.95 * b + 0.025)
    np.testing.assert_allclose(fuse_yaws([a, b]), mixed / mixed.sum())


def test_entropy_of_known_distributions():
    assert entropy(np.full(YAW_BINS, 1 / YAW_BINS)) == pytest.approx(np.log(YAW_BINS))
    assert entropy(np.eye(4)[0]) == pytest.approx(0.0, abs=1e-9)


def test_weak_modes_are_omitted():
    both = 0.96 * soft_labels(np.array([0.5]))[0] + 0.04 * soft_labels(np.array([3.6]))[0]
    assert len(modes(both)) == 1 and len(modes(both, min_ratio=0.03)) == 2
    assert len(modes(both, count=1, min_ratio=0.0)) == 1
