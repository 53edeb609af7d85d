"""Layouts: distances kept, reach, repeatability, and what is said when nothing fits."""

import numpy as np
import pytest
import trimesh

from sim_assets.cell.layout import (
    FreePose,
    LayoutError,
    PlanarPose,
    Region,
    draw_together,
    sample_layout,
    sample_roomy_layout,
)
from sim_assets.cell.outlines import gap, outline


def cylinder(radius):
    return trimesh.creation.cylinder(radius, 0.1, sections=64)


def mug():
    """A cylinder with a thin bar for a handle, out to x = 0.08."""
    bar = trimesh.creation.box((0.04, 0.01, 0.05), transform=np.eye(4))
    bar.apply_translation((0.06, 0, 0))
    return trimesh.util.concatenate([cylinder(0.04), bar])


def test_pose_turns_then_moves():
    np.testing.assert_allclose(
        PlanarPose(1, 2, np.pi / 2).transform(np.array([[1.0, 0]])), [[1, 3]], atol=1e-12
    )
    matrix = PlanarPose(1, 2, np.pi / 2).matrix
    np.testing.assert_allclose(matrix @ [1, 0, 0, 1], [1, 3, 0, 1], atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_layout_keeps_its_distances(seed):
    meshes = [mug(), mug(), cylinder(0.07), cylinder(0.03), cylinder(0.035), mug()]
    region = Region()
    poses = sample_layout(meshes, np.random.default_rng(seed), region, min_gap=0.04)
    polygons = [pose.transform(outline(mesh)) for pose, mesh in zip(poses, meshes, strict=True)]
    for i in range(len(meshes)):
        assert np.hypot(poses[i].x, poses[i].y) <= region.max_radius
        assert region.x[0] <= poses[i].x <= region.x[1] and region.y[0] <= poses[i].y <= region.y[1]
        for j in range(i):
            assert gap(polygons[i], polygons[j]) >= 0.04


@pytest.mark.parametrize("seed", range(5))
def test_without_a_gap_nothing_overlaps(seed):
    meshes = [cylinder(0.07)] * 6
    poses = sample_layout(meshes, np.random.default_rng(seed), min_gap=0.0)
    centers = np.array([(pose.x, pose.y) for pose in poses])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=-1) + np.eye(6)
    assert apart.min() > 0.14 - 0.001


def test_a_full_table_is_packed_tightly():
    """Ten bowls of 9 cm: dropped at random they hardly ever fit."""
    meshes = [cylinder(0.045)] * 10
    poses = sample_layout(meshes, np.random.default_rng(0))
    centers = np.array([(pose.x, pose.y) for pose in poses])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=-1) + np.eye(10)
    assert apart.min() >= 0.13 - 0.002


def test_same_seed_same_layout_and_other_seed_another():
    def layout(seed):
        return sample_layout([mug(), cylinder(0.05)], np.random.default_rng(seed))

    assert layout(1) == layout(1) != layout(2)


def test_too_many_objects_are_refused_with_a_count():
    with pytest.raises(LayoutError, match=r"30 objects do not fit .* 40 mm .*: at most \d+ were placed in 3"):
        sample_layout([cylinder(0.07)] * 30, np.random.default_rng(0), restarts=3)


def test_the_region_grows_only_if_it_has_to():
    few, many = [cylinder(0.05)] * 3, [cylinder(0.048)] * 11
    assert sample_roomy_layout(few, np.random.default_rng(1), Region()) == sample_layout(
        few, np.random.default_rng(1)
    )
    poses = sample_roomy_layout(many, np.random.default_rng(1), Region())
    assert max(np.hypot(pose.x, pose.y) for pose in poses) > Region().max_radius
    with pytest.raises(LayoutError):  # a region that was asked for stays as it is
        sample_roomy_layout(many, np.random.default_rng(1), Region(max_radius=0.69))


@pytest.mark.parametrize("spacing", [0.0, 0.01])
def test_objects_are_drawn_together_to_their_spacing(spacing):
    meshes = [mug(), cylinder(0.05), mug(), cylinder(0.03), cylinder(0.035)]
    poses = draw_together(meshes, sample_layout(meshes, np.random.default_rng(2)), spacing)
    polygons = [pose.transform(outline(mesh)) for pose, mesh in zip(poses, meshes, strict=True)]
    gaps = np.array([[gap(a, b) if a is not b else np.inf for b in polygons] for a in polygons])
    assert gaps.min() >= max(spacing, 0.0003)
    np.testing.assert_allclose(gaps.min(axis=1), max(spacing, 0.0004), atol=3e-4)


def test_free_pose_of_a_matrix():
    matrix = PlanarPose(0.4, -0.1, 0.7).matrix
    pose = FreePose.of(matrix)
    assert pose.position == PlanarPose(0.4, -0.1, 0.7).position
    np.testing.assert_allclose(pose.quat_wxyz, PlanarPose(0.4, -0.1, 0.7).quat_wxyz)
