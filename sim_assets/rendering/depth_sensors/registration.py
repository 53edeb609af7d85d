"""Colour and depth come from two cameras: small errors of registration and calibration, for training."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from perception.types import CameraIntrinsics

SHIFT = 3.0  # [px] at a focal length of 600 px, largest shift between colour and depth
PARALLAX = 0.004  # [m], largest error of the baseline between the two cameras
INTRINSICS_ERROR = 0.01  # largest relative error of the focal length
CENTRE_ERROR = 0.01  # largest error of the principal point, relative to the focal length
SCALE_ERROR = 0.01  # largest relative error of the depth


def misregister(
    rgb: UInt8[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    intrinsics: CameraIntrinsics,
    rng: np.random.Generator,
) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "h w"], CameraIntrinsics]:
    """Return colour, depth and intrinsics as an imperfectly calibrated camera delivers them.

    The depth is shifted by up to 3 px against the colour, by a constant and by a part that grows with
    inverse depth: near surfaces then cover others on one side and leave holes on the other. Focal lengths,
    principal point and the scale of depth are off by up to 1 %. Labels belong to the colour image, which
    stays as it is.
    """
    limit = SHIFT * min(intrinsics.fx / 600.0, 1.0)
    constant = rng.uniform(-limit / 2, limit / 2, 2)
    parallax = rng.uniform(-PARALLAX, PARALLAX) * intrinsics.fx
    depth = _shifted(
        depth * np.float32(1 + rng.uniform(-SCALE_ERROR, SCALE_ERROR)), constant, parallax, limit
    )
    focal = 1 + rng.uniform(-INTRINSICS_ERROR, INTRINSICS_ERROR)
    centre = rng.uniform(-CENTRE_ERROR, CENTRE_ERROR, 2) * intrinsics.fx
    camera = replace(
        intrinsics,
        fx=intrinsics.fx * focal,
        fy=intrinsics.fy * focal,
        cx=intrinsics.cx + centre[0],
        cy=intrinsics.cy + centre[1],
    )
    return rgb, depth, camera


def _shifted(
    depth: Float[np.ndarray, "h w"], constant: np.ndarray, parallax: float, limit: float
) -> Float[np.ndarray, "h w"]:
    """Warp the depth forward by ``constant`` + ``parallax`` / depth columns, the nearer surface in front."""
    rows = round(float(constant[1]))
    depth = cv2.warpAffine(
        depth,
        np.array([[1, 0, 0], [0, 1, rows]], dtype=np.float64),
        depth.shape[::-1],
        flags=cv2.INTER_NEAREST,
    )
    y, x = np.nonzero(depth)
    z = depth[y, x]
    columns = x + np.clip(np.rint(constant[0] + parallax / z), -limit, limit).astype(int)
    inside = (columns >= 0) & (columns < depth.shape[1])
    y, columns, z = y[inside], columns[inside], z[inside]
    targets = y * depth.shape[1] + columns
    if parallax > 0:  # of surfaces that meet in one pixel, the nearer one must be written last
        targets, z = targets[::-1].copy(), z[::-1].copy()
    warped = np.zeros(depth.size, dtype=np.float32)
    warped[targets] = z
    return warped.reshape(depth.shape)
