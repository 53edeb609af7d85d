"""What a camera with calibration errors and a limited sensor shows of the truth: its plane, its points.

Labels must agree with the images that a network sees. If colour and depth are shifted, or the depth scale is
1 % off, the visible table is not the plane z = 0, and an object's footprint is not where it stands.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

TABLE = SupportPlane(np.array([0.0, 0.0, 1.0]), 0.0)
_MIN_POINTS = 50  # of the table; with fewer its true plane is used
_MAX_POINTS = 3000
_THIN = 0.002  # [m] a surface within this height of z = 0 is the table
_FARTHEST = 0.05  # [m] from the true plane, of points that are fitted
_LIMITS = (0.8, 2.5)  # [m] range of the largest depth of images that end early
_BORDER = 0.08  # largest share of an image's width or height without depth at a border


def table_pixels(true: RgbdFrame, item: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the plane z = 0 in a frame without noise; ``item`` are those of things on it."""
    height = world_points(true)[..., 2]
    return (true.depth > 0) & ~item & (np.abs(height) < _THIN)


def world_points(frame: RgbdFrame) -> Float[np.ndarray, "h w 3"]:
    """Return the point of every pixel in the world in [m]; the camera's position where depth is missing."""
    k, T = frame.intrinsics, _pose(frame)
    u, v = np.meshgrid((np.arange(k.width) - k.cx) / k.fx, (np.arange(k.height) - k.cy) / k.fy)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    return (rays * frame.depth[..., None]) @ T[:3, :3].T + T[:3, 3]


def _pose(frame: RgbdFrame) -> Float[np.ndarray, "4 4"]:
    assert frame.T_world_camera is not None
    return frame.T_world_camera


def perceived_plane(
    frame: RgbdFrame, table: Bool[np.ndarray, "h w"], rng: np.random.Generator
) -> SupportPlane:
    """Return the plane through the depth at the table's pixels: total least squares on inliers."""
    rows = np.flatnonzero(table & (frame.depth > 0))
    if len(rows) < _MIN_POINTS:
        return TABLE
    chosen = rng.choice(rows, min(len(rows), _MAX_POINTS), replace=False)
    points = world_points(frame).reshape(-1, 3)[chosen]
    normal, offset, band = TABLE.normal, TABLE.offset, _FARTHEST
    for _ in range(4):
        distance = points @ normal - offset
        near = points[np.abs(distance - np.median(distance)) < band]
        if len(near) < _MIN_POINTS:
            return TABLE
        mean = near.mean(0)
        normal = np.linalg.svd((near - mean).T @ (near - mean))[0][:, 2]
        normal = normal if normal[2] > 0 else -normal
        offset = float(normal @ mean)
        band = max(3 * float(np.std(near @ normal - offset)), 0.002)
    return SupportPlane(normal, offset)


def depth_scale(frame: RgbdFrame, true: RgbdFrame, table: Bool[np.ndarray, "h w"]) -> float:
    """Return measured over true depth, the median over the table's pixels; 1 if there are few."""
    both = table & (frame.depth > 0)
    return float(np.median(frame.depth[both] / true.depth[both])) if both.sum() >= _MIN_POINTS else 1.0


def perceived_points(
    points_world: Float[np.ndarray, "n 3"], true: CameraIntrinsics, frame: RgbdFrame, scale: float
) -> Float[np.ndarray, "n 3"]:
    """Return where true points appear: projected by the true camera, back-projected by the frame's.

    Args:
        points_world: points in the true world in [m].
        true: intrinsics without error.
        frame: image with intrinsics in error and the true pose.
        scale: measured over true depth.
    """
    T, k = _pose(frame), frame.intrinsics
    x, y, z = ((points_world - T[:3, 3]) @ T[:3, :3]).T
    u, v = true.fx * x / z + true.cx, true.fy * y / z + true.cy
    seen = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(z)], axis=1) * (scale * z)[:, None]
    return seen @ T[:3, :3].T + T[:3, 3]


def cut_depth(depth: Float[np.ndarray, "h w"], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return the depth without what a sensor's range, or a registration's border, leaves out."""
    depth = depth.copy()
    draw = rng.random()
    if draw < 0.6:
        depth[depth > np.exp(rng.uniform(*np.log(_LIMITS)))] = 0
    if draw > 0.4:
        h, w = depth.shape
        top, left, bottom, right = (rng.uniform(0, _BORDER, 4) * (h, w, h, w)).astype(int)
        kept = np.zeros(depth.shape, np.uint8)
        cv2.rectangle(kept, (left, top), (w - 1 - right, h - 1 - bottom), 1, -1)
        depth[kept == 0] = 0
    return depth
