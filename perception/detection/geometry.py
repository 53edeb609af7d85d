"""Geometry of a frame's pixels relative to the support plane: heights, plan coordinates, headings."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from perception.types import RgbdFrame, SupportPlane


def camera_pose(frame: RgbdFrame) -> Float[np.ndarray, "4 4"]:
    """Return T_world_camera; the camera of a frame without a pose is the world."""
    return np.eye(4) if frame.T_world_camera is None else frame.T_world_camera


def plane_axes(plane: SupportPlane) -> Float[np.ndarray, "2 3"]:
    """Return the axes of plan coordinates and yaw: world x projected onto the plane, and normal × it.

    If the normal is nearly parallel to world x, which can only happen in a camera frame, world y is
    projected.
    """
    seed = np.array([1.0, 0.0, 0.0]) if abs(plane.normal[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = seed - (seed @ plane.normal) * plane.normal
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(plane.normal, first)])


def linear_in_depth(frame: RgbdFrame, direction: Float[np.ndarray, "3"]) -> tuple[np.ndarray, float]:
    """Return (slope (H, W), constant) such that ``direction . p_world = slope * depth + constant``."""
    T = camera_pose(frame)
    camera, k = T[:3, :3].T @ direction, frame.intrinsics
    x = (np.arange(k.width) - k.cx) / k.fx * camera[0]
    y = (np.arange(k.height) - k.cy) / k.fy * camera[1] + camera[2]
    return np.add.outer(y, x).astype(np.float32), float(direction @ T[:3, 3])


def height_image(
    frame: RgbdFrame, plane: SupportPlane, depth: Float[np.ndarray, "h w"] | None = None
) -> Float[np.ndarray, "h w"]:
    """Return the height of every pixel's point above the plane in metres; undefined where depth is 0.

    Args:
        frame: Camera and depth.
        plane: Support plane in the world frame.
        depth: Depth to use instead of the frame's, for instance filtered.
    """
    slope, constant = linear_in_depth(frame, plane.normal)
    return (frame.depth if depth is None else depth) * slope + np.float32(constant - plane.offset)


def bounding_window(mask: Bool[np.ndarray, "h w"], margin: int = 0) -> tuple[slice, slice]:
    """Return rows and columns of the mask's bounding box, extended by ``margin`` pixels, in the image."""
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    return slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin)


def touches_border(mask: Bool[np.ndarray, "h w"], margin: int = 0) -> bool:
    """Return whether the mask is truncated by the image border, or ends within ``margin`` pixels of it."""
    k = margin + 1
    return bool(mask[:k].any() or mask[-k:].any() or mask[:, :k].any() or mask[:, -k:].any())


def points_of(
    frame: RgbdFrame,
    mask: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Return the world points of the mask's measured pixels in metres, in row-major pixel order."""
    depth = frame.depth if depth is None else depth
    window = bounding_window(mask)
    v, u = np.nonzero(mask[window] & (depth[window] > 0))
    v, u = v + window[0].start, u + window[1].start
    z, k, T = depth[v, u].astype(np.float64), frame.intrinsics, camera_pose(frame)
    points_camera = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1)
    return points_camera @ T[:3, :3].T + T[:3, 3]


def plan_coordinates(points_world: Float[np.ndarray, "n 3"], plane: SupportPlane) -> Float[np.ndarray, "n 2"]:
    """Return the coordinates of points along ``plane_axes`` in metres."""
    return points_world @ plane_axes(plane).T


def project(
    frame: RgbdFrame, points_world: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """Return the rounded pixels (u, v) of world points, possibly off the image, and their depths in [m]."""
    T, k = camera_pose(frame), frame.intrinsics
    points_camera = (points_world - T[:3, 3]) @ T[:3, :3]
    z = points_camera[:, 2]
    safe = np.where(z > 1e-6, z, 1.0)  # pixels behind the camera are arbitrary
    u = points_camera[:, 0] / safe * k.fx + k.cx
    v = points_camera[:, 1] / safe * k.fy + k.cy
    return np.rint(np.stack([u, v], axis=1)).astype(np.int64), z


def in_image(
    frame: RgbdFrame, pixels: Int[np.ndarray, "n 2"], depth: Float[np.ndarray, "n"]
) -> Bool[np.ndarray, "n"]:
    """Return which projected points are in front of the camera and in the image, see ``project``."""
    size = (frame.intrinsics.width, frame.intrinsics.height)
    return (depth > 0) & ((pixels >= 0) & (pixels < size)).all(axis=1)


def view_heading(
    frame: RgbdFrame, plane: SupportPlane, point_world: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Return the unit direction in the plane that points away from the camera at the point.

    It and the plane's normal project onto the same line through the point's pixel: upwards in a
    gravity-aligned image. For a view from straight above, where the ray has no component in the plane, it is
    the direction of the image's top.
    """
    T, n = camera_pose(frame), plane.normal
    ray = point_world - T[:3, 3]
    ray = ray / np.linalg.norm(ray)
    heading = ray - (ray @ n) * n
    if np.linalg.norm(heading) < np.sin(np.radians(3.0)):
        heading = -T[:3, 1] + (T[:3, 1] @ n) * n
    return heading / np.linalg.norm(heading)


def heading_angle(heading: Float[np.ndarray, "3"], plane: SupportPlane) -> float:
    """Return the angle in radians of a direction in the plane, from the first of ``plane_axes``."""
    along = plane_axes(plane) @ heading
    return float(np.arctan2(along[1], along[0]))
