"""Points and surface normals on a coarse pixel grid of the depth images, with their expected noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from perception.detection.geometry import camera_pose
from perception.types import RgbdFrame

_STEP = 1e-4  # [m] resolution at which depth is filtered: integers are filtered four times faster
_BASELINE = 0.025  # of the image's width, between the points of which a normal is the cross product


@dataclass(frozen=True)
class Samples:
    """Samples of all frames, one after the other, each a pixel grid in row-major order.

    Attributes:
        points: (n, 3) points in the world frame, in metres; arbitrary where not ``valid``.
        normals: (n, 3) unit normals in the world frame, towards the camera; 0 where unknown.
        depth: (n,) depth in metres; 0 where it was not measured.
        valid: (n,) whether depth was measured within the largest depth.
        view: (n,) index of the frame.
        shapes: Rows and columns of each frame's grid.
        centres: (f, 3) camera centres in the world frame, in metres.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    depth: Float[np.ndarray, "n"]
    valid: Bool[np.ndarray, "n"]
    view: Int[np.ndarray, "n"]
    shapes: tuple[tuple[int, int], ...]
    centres: Float[np.ndarray, "f 3"]

    def beside(self, chosen: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        """Return the chosen samples, and those so near in the image that they may lack a normal."""
        parts, start = [], 0
        for rows, columns in self.shapes:
            kernel = np.ones((2 * normal_reach(columns) + 1,) * 2, np.uint8)
            part = chosen[start : start + rows * columns].reshape(rows, columns).astype(np.uint8)
            parts.append(np.asarray(cv2.dilate(part, kernel)).ravel() > 0)
            start += rows * columns
        return np.concatenate(parts)


def depth_noise(depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the standard deviation of the depth in metres, that of the noisiest of the usual sensors.

    The Kinect v1: Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise", 3DIMPVT 2012.
    """
    return np.asarray(0.0012 + 0.0019 * (depth - 0.4) ** 2)


def sample_frames(frames: Sequence[RgbdFrame], count: int, max_depth: float) -> Samples:
    """Return about ``count`` samples of each frame's depth, median-filtered over 5 x 5 pixels.

    Args:
        frames: Frames; the camera of one without a pose is the world.
        count: Number of samples of a frame.
        max_depth: Largest depth of a valid sample, in metres.
    """
    parts = [_sample(frame, count, max_depth) for frame in frames]
    points, normals, depth, shapes = zip(*parts)
    views = [np.full(len(p), i, np.int32) for i, p in enumerate(points)]
    z = np.concatenate(depth)
    return Samples(
        np.concatenate(points),
        np.concatenate(normals),
        z,
        z > 0,
        np.concatenate(views),
        shapes,
        np.stack([camera_pose(frame)[:3, 3] for frame in frames]),
    )


def _sample(
    frame: RgbdFrame, count: int, max_depth: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]:
    k, T = frame.intrinsics, camera_pose(frame)
    stride = max(1, round(float(np.sqrt(k.width * k.height / count))))
    near = np.where(frame.depth < max_depth, frame.depth, np.float32(0))
    steps = cv2.medianBlur((near * np.float32(1 / _STEP) + np.float32(0.5)).astype(np.uint16), 5)
    first = stride // 2
    z = np.asarray(steps)[first::stride, first::stride].astype(np.float32) * np.float32(_STEP)
    u = (np.arange(first, k.width, stride, dtype=np.float32) - k.cx) / k.fx
    v = (np.arange(first, k.height, stride, dtype=np.float32) - k.cy) / k.fy
    camera = np.stack([z * u, z * v[:, None], z], axis=-1)
    normals = _normals(camera, normal_reach(camera.shape[1]))
    R = T[:3, :3].astype(np.float32)
    points = camera.reshape(-1, 3) @ R.T + T[:3, 3].astype(np.float32)
    return points, normals.reshape(-1, 3) @ R.T, z.ravel(), (len(v), len(u))


def normal_reach(columns: int) -> int:
    """Return the number of samples to each side from which a normal is computed."""
    return max(1, round(_BASELINE * columns / 2))


def _normals(points: Float[np.ndarray, "r c 3"], reach: int) -> Float[np.ndarray, "r c 3"]:
    """Return unit normals towards the camera from differences over ``reach`` samples to each side."""
    result = np.zeros_like(points)
    if min(points.shape[:2]) <= 2 * reach:
        return result
    inner = slice(reach, -reach)
    right, left = points[inner, 2 * reach :], points[inner, : -2 * reach]
    low, high = points[2 * reach :, inner], points[: -2 * reach, inner]
    a, b = right - left, high - low
    normal = np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )
    known = (right[..., 2] > 0) & (left[..., 2] > 0) & (low[..., 2] > 0) & (high[..., 2] > 0)
    length = np.sqrt((normal**2).sum(-1))
    scale = np.where(known & (length > 0), 1 / np.maximum(length, 1e-12), 0)
    towards = np.where((normal * points[inner, inner]).sum(-1) > 0, -1, 1)
    result[inner, inner] = normal * (scale * towards)[..., None]
    return result
