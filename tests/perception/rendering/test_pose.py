"""Poses with scale: camera maps and their derivatives."""

import numpy as np
import pytest

from perception.geometry import rigid, se3_exp, so3_exp
from perception.rendering.pose import (
    ObjectPose,
    canonical_from_camera,
    map_jacobian,
    object_by_camera,
    pose_jacobian,
)
from perception.rendering.renderer import RayBundle, Rendering

POSE = ObjectPose(
    so3_exp(np.array([0.3, -0.2, 0.9])), np.array([0.4, -0.1, 0.05]), np.array([0.04, 0.05, 0.07])
)
CAMERAS = np.stack([
    rigid(so3_exp(np.array([2.0, 0.3, 0.1])), np.array([0.1, 0.2, 0.6])),
    rigid(so3_exp(np.array([1.5, -0.8, 0.4])), np.array([0.7, -0.3, 0.5])),
])  # fmt: skip


def test_steps_turn_in_the_object_frame_move_in_the_world_and_scale_by_factors() -> None:
    step = np.array([0.1, 0.2, -0.3, 0.01, 0.02, 0.03, 0.5, 0.0, -0.5])
    moved = POSE.moved(step)
    np.testing.assert_allclose(moved.rotation, POSE.rotation @ so3_exp(step[:3]), atol=1e-12)
    np.testing.assert_allclose(moved.translation, POSE.translation + step[3:6])
    np.testing.assert_allclose(moved.scale, POSE.scale * np.exp([0.5, 0, -0.5]))


def test_a_turn_about_a_point_leaves_that_point_where_it_is() -> None:
    point, turn = np.array([0.01, 0.02, 0.05]), np.array([0.3, -0.2, 0.0])
    turned = POSE.turned(turn, point)
    before, after = (p.rotation @ point + p.translation for p in (POSE, turned))
    np.testing.assert_allclose(after, before, atol=1e-12)
    np.testing.assert_allclose(turned.rotation, POSE.rotation @ so3_exp(turn), atol=1e-12)


def test_rotations_stay_orthonormal() -> None:
    drifted = ObjectPose(POSE.rotation * 1.001, POSE.translation, POSE.scale).moved(np.zeros(9))
    np.testing.assert_allclose(drifted.rotation @ drifted.rotation.T, np.eye(3), atol=1e-12)


def test_a_pose_and_its_matrix() -> None:
    again = ObjectPose.of(POSE.T_world_object, POSE.scale)
    np.testing.assert_array_equal(again.rotation, POSE.rotation)
    np.testing.assert_array_equal(again.translation, POSE.translation)


def test_camera_maps_invert_the_pose() -> None:
    canonical = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    world = (POSE.scale * canonical) @ POSE.rotation.T + POSE.translation
    for T, A in zip(CAMERAS, canonical_from_camera(POSE, CAMERAS), strict=True):
        camera = (world - T[:3, 3]) @ T[:3, :3]
        np.testing.assert_allclose(camera @ A[:, :3].T + A[:, 3], canonical, atol=1e-12)


def test_map_jacobian_equals_finite_differences() -> None:
    """The twelve entries of each map, column by column, with respect to the nine parameters."""
    jacobian = map_jacobian(POSE, canonical_from_camera(POSE, CAMERAS))
    for k in range(9):
        step = 1e-6 * np.eye(9)[k]
        ahead, behind = (canonical_from_camera(POSE.moved(s), CAMERAS) for s in (step, -step))
        numeric = np.moveaxis(ahead - behind, 2, 1).reshape(2, 12) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, k], numeric, atol=1e-4, err_msg=str(k))


def test_pose_jacobian_is_the_chain_rule_for_each_cameras_rays() -> None:
    rays = RayBundle(np.ones((3, 3), np.float32), np.array([0, 0, 1]), np.ones((2, 2)), 8)
    d_map = np.random.default_rng(1).standard_normal((3, 12)).astype(np.float32)
    A = canonical_from_camera(POSE, CAMERAS)
    zeros = np.zeros(3, np.float32)
    found = pose_jacobian(POSE, A, rays, Rendering(zeros, zeros, zeros, d_map=d_map))
    maps = map_jacobian(POSE, A)
    np.testing.assert_allclose(found, [d_map[0] @ maps[0], d_map[1] @ maps[0], d_map[2] @ maps[1]], rtol=1e-4)
    with pytest.raises(ValueError, match="no gradients"):
        pose_jacobian(POSE, A, rays, Rendering(zeros, zeros, zeros))


def test_a_motion_of_the_camera_looks_like_the_opposite_motion_of_the_object() -> None:
    xi = 1e-5 * np.array([1.0, -2.0, 0.5, 0.3, -0.4, 0.7])
    seen = canonical_from_camera(POSE, (CAMERAS[0] @ se3_exp(xi))[None])
    step = np.concatenate([object_by_camera(POSE, CAMERAS[0]) @ xi, np.zeros(3)])
    same = canonical_from_camera(POSE.moved(step), CAMERAS[:1])
    np.testing.assert_allclose(seen, same, atol=1e-7)
