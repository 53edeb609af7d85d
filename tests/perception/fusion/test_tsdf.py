"""TSDF fusion of a rendered can, and closing of synthetic distance fields."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.fusion.tsdf import (
    FusionUnavailableError,
    TsdfConfig,
    _closed_surface,
    masked_cloud,
    reconstruct_tsdf,
)
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

CAMERA = CameraIntrinsics(width=160, height=120, fx=145.0, fy=145.0, cx=79.5, cy=59.5)
CENTER, RADIUS, HEIGHT = np.array([0.4, -0.2]), 0.035, 0.12


def camera_at(position, target=(0.4, -0.2, 0.05)):
    z = np.array(target) - position
    z = z / np.linalg.norm(z)
    x = np.cross(z, (0, 0, 1.0))
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = position
    return T


def view_of_a_can(T_world_camera):
    """Depth and mask of an upright closed cylinder on the table, by ray casting in closed form."""
    v, u = np.indices((CAMERA.height, CAMERA.width))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    rays = rays @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    table, top = (-origin[2] / rays[..., 2], (HEIGHT - origin[2]) / rays[..., 2])
    on_top = np.linalg.norm(origin[:2] + top[..., None] * rays[..., :2] - CENTER, axis=-1) <= RADIUS
    offset = origin[:2] - CENTER
    a = (rays[..., :2] ** 2).sum(-1)
    b = rays[..., :2] @ offset
    root = b**2 - a * (offset @ offset - RADIUS**2)
    side = (-b - np.sqrt(np.maximum(root, 0))) / a
    z = origin[2] + side * rays[..., 2]
    on_side = (root > 0) & (side > 0) & (z >= 0) & (z <= HEIGHT)
    depth = np.where(on_top, top, np.where(on_side, side, table)).astype(np.float32)
    frame = RgbdFrame(0.0, np.zeros((120, 160, 3), np.uint8), depth, CAMERA, T_world_camera)
    return frame, ObjectDetection("can", 0.9, on_top | on_side, instance_id=5)


@pytest.fixture(scope="module")
def views():
    angles = np.deg2rad((0, 120, 240))
    return [view_of_a_can(camera_at((0.4 + 0.3 * np.cos(a), -0.2 + 0.3 * np.sin(a), 0.4))) for a in angles]


def test_masked_cloud_lies_on_the_surface(views):
    frame, found = views[0]
    points = masked_cloud(frame, found.mask)
    on_side = np.abs(np.linalg.norm(points[:, :2] - CENTER, axis=1) - RADIUS) < 1e-3
    on_top = np.abs(points[:, 2] - HEIGHT) < 1e-3
    assert len(points) == found.mask.sum() and (on_side | on_top).all()


def test_three_views_give_a_closed_can_of_the_right_size(views):
    frames, found = zip(*views, strict=True)
    (can,) = reconstruct_tsdf(frames, [[f] for f in found], SupportPlane())
    mesh = trimesh.Trimesh(can.mesh_world.vertices, can.mesh_world.faces)
    assert can.id == 5 and can.category == "can" and can.n_views == 3
    assert mesh.is_watertight and mesh.volume == pytest.approx(np.pi * RADIUS**2 * HEIGHT, rel=0.1)
    assert can.height == pytest.approx(HEIGHT, abs=0.004) and can.radius == pytest.approx(RADIUS, abs=0.003)
    np.testing.assert_allclose(can.T_world_object[:2, 3], CENTER, atol=0.002)
    np.testing.assert_allclose(can.mesh.vertices.min(0) + can.mesh.vertices.max(0), 0, atol=1e-9)


def test_the_open_surface_ends_where_nothing_was_seen(views):
    frame, found = views[0]
    (can,) = reconstruct_tsdf([frame], [[found]], SupportPlane(), TsdfConfig(closed=False))
    points = can.mesh_world.vertices
    off_side = np.abs(np.linalg.norm(points[:, :2] - CENTER, axis=1) - RADIUS)
    off_top = np.abs(points[:, 2] - HEIGHT)
    assert np.quantile(np.minimum(off_side, off_top), 0.95) < 0.002
    towards_camera = (points[:, :2] - CENTER) @ (1.0, 0.0)  # the camera stands on the +x side
    low = points[:, 2] < 0.08
    assert low.any() and towards_camera[low].min() > -0.01 and points[:, 2].min() > 0.002


def test_an_object_without_depth_is_left_out(views, caplog):
    frame, found = views[0]
    hole = RgbdFrame(0.0, frame.rgb, np.where(found.mask, 0, frame.depth), CAMERA, frame.T_world_camera)
    assert reconstruct_tsdf([hole], [[found]], SupportPlane()) == []
    assert "can 5 has too little depth" in caplog.text


def test_missing_open3d_names_the_packages_to_install(views, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(FusionUnavailableError, match=r"pip install '\.\[eval\]'"):
        reconstruct_tsdf([views[0][0]], [[views[0][1]]], SupportPlane())


# A sphere's signed distance, sampled at the centres of 40^3 voxels whose lowest corner is at CORNER.
VOXEL, BALL = 0.005, 0.06
CORNER, MIDDLE = np.array([0.1, -0.3, -0.02]), np.array([0.2, -0.2, 0.08])


def ball_values(middle=MIDDLE, radius=BALL) -> np.ndarray:
    """Signed distance in units of the truncation distance of 0.02 m, and weight 1."""
    centres = CORNER + VOXEL * (np.stack(np.indices((40, 40, 40)), axis=-1) + 0.5)
    distance = np.linalg.norm(centres - middle, axis=-1) - radius
    return np.stack([np.clip(distance / 0.02, -1, 1), np.ones_like(distance)], axis=-1)


def ball_points() -> np.ndarray:
    direction = np.random.default_rng(0).normal(size=(3000, 3))
    return MIDDLE + BALL * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def closed(values: np.ndarray) -> trimesh.Trimesh:
    mesh = _closed_surface(values, CORNER, VOXEL, ball_points(), SupportPlane())
    assert mesh is not None
    return trimesh.Trimesh(mesh.vertices, mesh.faces)


def test_the_zero_level_of_an_observed_ball():
    mesh = closed(ball_values())
    assert mesh.is_watertight
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - MIDDLE, axis=1), BALL, atol=3e-4)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * BALL**3, rel=0.02)


def test_unobserved_space_below_the_points_is_solid_down_to_the_plane():
    """The lower half is unobserved: the ball becomes a dome on a cylinder that ends at the plane z = 0."""
    values = ball_values()
    values[:, :, :20] = (1.0, 0.0)  # up to the middle's height
    mesh = closed(values)
    assert mesh.is_watertight
    dome, column = 2 / 3 * np.pi * BALL**3, np.pi * BALL**2 * MIDDLE[2]
    assert mesh.volume == pytest.approx(dome + column, rel=0.05)
    assert mesh.bounds[0, 2] == pytest.approx(0, abs=VOXEL / 2)
    assert mesh.bounds[1, 2] == pytest.approx(MIDDLE[2] + BALL, abs=1e-3)


def test_unobserved_space_above_and_beside_the_points_is_free():
    values = ball_values()
    values[values[..., 0] >= 1, 1] = 0.0
    mesh = closed(values)
    np.testing.assert_allclose(mesh.bounds[1], MIDDLE + BALL, atol=1e-3)
    assert mesh.bounds[0, 0] == pytest.approx(MIDDLE[0] - BALL, abs=1e-3)


def test_smaller_components_and_the_support_are_removed():
    values = ball_values()
    values[2:4, 2:4, 20:22, 0] = -1.0  # a speck
    values[:, :, :2, 0] = -1.0  # the table, 0.01 m thick
    values[18:22, 18:22, 36:38, 0] = -1.0  # a speck above the ball
    mesh = closed(values)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - MIDDLE, axis=1), BALL, atol=3e-4)


def test_without_solid_voxels_there_is_no_surface():
    values = ball_values()
    values[..., 0] = 1.0
    assert _closed_surface(values, CORNER, VOXEL, ball_points(), SupportPlane()) is None


def test_the_most_probable_yaw_turns_the_frame_but_not_the_mesh(views):
    frames, found = zip(*views, strict=True)
    bins = np.full(36, 0.01)
    bins[6] = 1 - 35 * 0.01  # 60 degrees
    turned = [[replace(f, category="mug", yaw_probabilities=bins)] for f in found]
    (can,) = reconstruct_tsdf(frames, [[f] for f in found], SupportPlane())
    (mug,) = reconstruct_tsdf(frames, turned, SupportPlane())
    np.testing.assert_allclose(can.T_world_object[:3, :3], np.eye(3), atol=1e-12)
    c, s = 0.5, np.sqrt(0.75)
    np.testing.assert_allclose(mug.T_world_object[:2, :2], [[c, -s], [s, c]], atol=1e-9)
    np.testing.assert_allclose(mug.mesh_world.vertices, can.mesh_world.vertices, atol=1e-6)
    assert can.scale == pytest.approx(np.full(3, HEIGHT / 1.8), abs=0.003)


def test_stray_pixels_far_from_the_object_are_ignored(views):
    frames, found = zip(*views, strict=True)
    oversized = [replace(f, mask=f.mask | (np.indices(f.mask.shape)[0] < 8)) for f in found]  # far table
    (can,) = reconstruct_tsdf(frames, [[f] for f in oversized], SupportPlane())
    assert can.height == pytest.approx(HEIGHT, abs=0.004) and can.radius == pytest.approx(RADIUS, abs=0.004)


def test_frames_without_a_pose_and_masks_without_an_instance_are_ignored(views):
    frame, found = views[0]
    assert reconstruct_tsdf([replace(frame, T_world_camera=None)], [[found]], SupportPlane()) == []
    assert reconstruct_tsdf([frame], [[replace(found, instance_id=None)]], SupportPlane()) == []


def test_too_few_points_are_not_fused(views):
    frame, found = views[0]
    n = len(masked_cloud(frame, found.mask))
    assert reconstruct_tsdf([frame], [[found]], SupportPlane(), TsdfConfig(min_points=n + 1)) == []
