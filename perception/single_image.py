"""Reconstruction of a single RGB-D image given as arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from perception.errors import InvalidInputError
from perception.pipeline import Perception
from perception.reconstruction import Reconstruction
from perception.scans import reconstruct
from perception.types import CameraIntrinsics, RgbdFrame, check_rigid

_MAX_METRES = 100.0  # median depth beyond which the unit cannot be metres


def reconstruct_image(
    color: np.ndarray,
    depth: np.ndarray,
    K: ArrayLike,
    T_world_camera: ArrayLike | None = None,
    perception: Perception | None = None,
) -> Reconstruction:
    """Reconstruct all objects in one RGB-D image: class, complete mesh, pose and uncertainty of each.

    Without a camera pose the results are in the camera frame (x right, y down, z forward);
    ``Reconstruction.in_world`` moves them once the pose is known. The objects must stand on a plane that is
    visible in the image.

    Args:
        color: (H, W, 3) uint8 RGB image.
        depth: (H, W) depth along the optical axis, registered to ``color``: floats in metres or uint16 in
            millimetres. Pixels that are NaN, infinite, zero or negative are missing measurements (ROS marks
            them as NaN, too close as -inf, too far as inf: REP 118).
        K: (3, 3) camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, without distortion.
        T_world_camera: (4, 4) camera pose in a world frame whose z axis points up; None if unknown.
        perception: the networks from ``load_perception``; by default the shipped ones, loaded on first use.

    Returns:
        The objects; each has ``category``, ``mesh`` (object frame), ``mesh_world``, ``T_world_object`` and
        ``surface_sigma``, the standard deviation of each vertex along its normal in metres.

    Raises:
        InvalidInputError: an array has the wrong shape, type or unit, or no depth was measured; the message
            names it.
        PerceptionError: no support plane is visible.
    """
    return reconstruct([image_frame(color, depth, K, T_world_camera)], perception)


def image_frame(
    color: np.ndarray, depth: np.ndarray, K: ArrayLike, T_world_camera: ArrayLike | None = None
) -> RgbdFrame:
    """Return the arrays as a validated frame; shapes and units as in ``reconstruct_image``.

    Raises:
        InvalidInputError: an array has the wrong shape, type or unit, or no depth was measured; the message
            names it.
    """
    color, depth = np.asarray(color), np.asarray(depth)
    if color.ndim != 3 or color.shape[2] != 3 or color.dtype != np.uint8:
        raise InvalidInputError(f"color must be (H, W, 3) uint8 RGB, got {color.shape} {color.dtype}")
    height, width = color.shape[:2]
    if depth.shape != (height, width):
        raise InvalidInputError(
            f"depth is {depth.shape} but color is {(height, width)}: register and resize depth to color"
        )
    pose = None if T_world_camera is None else check_rigid(np.asarray(T_world_camera), "T_world_camera")
    return RgbdFrame(0.0, color, _metres(depth), _intrinsics(np.asarray(K), width, height), pose)


def _metres(depth: np.ndarray) -> np.ndarray:
    """Return the depth image as float32 metres, missing measurements as 0."""
    if depth.dtype == np.uint16:
        depth = depth.astype(np.float32) * np.float32(0.001)
    elif depth.dtype.kind != "f":
        raise InvalidInputError(f"depth must be float metres or uint16 millimetres, got {depth.dtype}")
    measured = np.isfinite(depth) & (depth > 0)
    if not measured.any():
        raise InvalidInputError("depth has no measurement: every pixel is NaN, infinite, zero or negative")
    median = np.median(depth[measured])
    if median > _MAX_METRES:
        raise InvalidInputError(
            f"the median depth of {median:.4g} m cannot be in metres: divide millimetres by 1000"
        )
    return np.where(measured, depth, 0).astype(np.float32)


def _intrinsics(K: np.ndarray, width: int, height: int) -> CameraIntrinsics:
    if K.shape != (3, 3) or K.dtype.kind not in "fiu" or not np.isfinite(K).all():
        raise InvalidInputError(f"K must be a finite (3, 3) camera matrix, got {K.shape} {K.dtype}")
    if K[0, 1] or K[1, 0] or not np.array_equal(K[2], (0, 0, 1)):
        raise InvalidInputError(
            f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}: a camera without skew"
        )
    return CameraIntrinsics(width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
