"""Gravity-upright square crops of an instance, what the class and yaw networks look at.

Channels (SIDE x SIDE each): masked RGB, the mask, the height above the support plane, the depth relative to
the instance's median. Two numbers beside them say what the picture cannot: the crop's side in metres and the
elevation it was seen from.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.detection.geometry import camera_pose, height_image, view_heading, window_of
from perception.errors import InvalidInputError
from perception.types import RgbdFrame, SupportPlane

SIDE = 64
CHANNELS = 6
CONTEXT = 2
_MARGIN = 1.1  # side of the crop over the longer side of the mask's box
_HEIGHT_RANGE = 0.30  # [m] above the plane that 8 bits cover
_DEPTH_RANGE = 0.20  # [m] to either side of the median depth that 8 bits cover


@dataclass(frozen=True)
class Crop:
    """One instance, cut out.

    Attributes:
        image: (SIDE, SIDE, 6) uint8: red, green, blue, mask (0 or 255, between along the edge), height above
            the plane (0 to 0.3 m), depth minus its median (-0.2 to 0.2 m); 0 outside the mask.
        context: (2,) log of the crop's side in [m] over 0.15 m, sine of the elevation of the view.
        heading: (3,) world direction in the plane that points up in the crop; yaw is counted from it.
    """

    image: UInt8[np.ndarray, "side side 6"]
    context: Float[np.ndarray, "2"]
    heading: Float[np.ndarray, "3"]


def crop(
    frame: RgbdFrame,
    mask: Bool[np.ndarray, "h w"],
    plane: SupportPlane,
    filtered: tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]] | None = None,
) -> Crop:
    """Cut the masked instance out of the frame, turned so that gravity points down.

    Args:
        filtered: (depth, height above the plane) of the frame, where the caller has them already
            (``filtered_geometry``); they are the same for all crops of a frame.

    Raises:
        InvalidInputError: the mask holds no measured depth.
    """
    depth, height = filtered or filtered_geometry(frame, plane)
    window = window_of(mask)
    mask, depth, height, rgb = mask[window], depth[window], height[window], frame.rgb[window]
    inside = mask & (depth > 0)
    if not inside.any():
        raise InvalidInputError("cannot crop an instance without a single measured depth pixel in its mask")
    median = float(np.median(depth[inside]))
    centre = _centre(frame, window, inside, depth)
    heading = view_heading(frame, plane, centre)
    A, side_pixels = _upright_warp(frame, mask, centre, heading)

    up = np.where(inside, np.clip(height / _HEIGHT_RANGE, 0, 1) * 255, 0)
    relative = np.where(inside, np.clip((depth - median) / _DEPTH_RANGE * 0.5 + 0.5, 0, 1) * 255, 0)
    channels = [rgb * mask[..., None], mask * np.uint8(255), up.astype(np.uint8), relative.astype(np.uint8)]
    image = _resampled(np.dstack(channels), A)

    ray = centre - camera_pose(frame)[:3, 3]
    elevation = -(ray @ plane.normal) / np.linalg.norm(ray)
    side = side_pixels * median / np.sqrt(frame.intrinsics.fx * frame.intrinsics.fy)
    context = np.array([np.log(side / 0.15), elevation], dtype=np.float32)
    return Crop(image=image, context=context, heading=heading)


def _centre(
    frame: RgbdFrame,
    window: tuple[slice, slice],
    inside: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
) -> Float[np.ndarray, "3"]:
    """Centroid in the world of the window's points inside the mask."""
    v, u = np.nonzero(inside)
    z, k, T = depth[v, u].astype(np.float64), frame.intrinsics, camera_pose(frame)
    x = (u + window[1].start - k.cx) / k.fx * z
    y = (v + window[0].start - k.cy) / k.fy * z
    return T[:3, :3] @ (x.mean(), y.mean(), z.mean()) + T[:3, 3]


def filtered_geometry(
    frame: RgbdFrame, plane: SupportPlane
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """(median-filtered depth, height above the plane) in [m]."""
    depth = cv2.medianBlur(np.ascontiguousarray(frame.depth), 5)
    return depth, height_image(frame, plane, depth)


def _upright_warp(
    frame: RgbdFrame,
    mask: Bool[np.ndarray, "h w"],
    centre: Float[np.ndarray, "3"],
    heading: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "2 3"], float]:
    """(affine map from pixels of the mask's window to the crop's, the crop's side in image pixels)."""
    k, R = frame.intrinsics, camera_pose(frame)[:3, :3]
    # The image of a step along the heading, from the projection's derivative (rounding has no say here).
    x, y, z = R.T @ (centre - camera_pose(frame)[:3, 3])
    dx, dy, dz = R.T @ heading
    step = np.array([k.fx * (dx - x / z * dz), k.fy * (dy - y / z * dz)])
    up = step / np.linalg.norm(step)
    turn = np.array([[-up[1], up[0]], [-up[0], -up[1]]])  # rows: the crop's right and down in image axes

    outline = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
    corners = np.concatenate([contour[:, 0] for contour in outline]) @ turn.T
    low, high = corners.min(0), corners.max(0)
    side = float(max((high - low).max() + 1, 8.0)) * _MARGIN
    scale = SIDE / side
    middle = (low + high) / 2
    offset = (SIDE - 1) / 2 - scale * middle
    return np.hstack([scale * turn, offset[:, None]]), side


def _resampled(
    stack: UInt8[np.ndarray, "h w c"], A: Float[np.ndarray, "2 3"]
) -> UInt8[np.ndarray, "side side c"]:
    """The image warped to the crop; strongly shrunk ones by way of four times the pixels, then averaged."""
    factor = 4 if np.linalg.norm(A[0, :2]) < 0.6 else 1
    fine = factor * A
    fine[:, 2] += (factor - 1) / 2  # pixel centres at integers in both images
    warped = cv2.warpAffine(stack[..., :4], fine, (SIDE * factor,) * 2, flags=cv2.INTER_LINEAR)
    geometry = cv2.warpAffine(stack[..., 4:], fine, (SIDE * factor,) * 2, flags=cv2.INTER_LINEAR)
    both = np.dstack([warped, geometry])
    return both if factor == 1 else cv2.resize(both, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
