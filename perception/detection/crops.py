"""Gravity-aligned square crops around an instance: the input of the class and yaw networks.

Channels (SIDE x SIDE each): RGB, mask, height above the support plane, depth relative to the instance's
median. All but the mask include the context, so that errors of the mask (a missing handle, part of a
neighbour) and truncation by occluders or the image border can be recognised. Two scalars complete the input:
the side of the crop in metres and the elevation of the view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from perception.depth_cleaning import clean_frame
from perception.detection.geometry import bounding_window, camera_pose, height_image, view_heading
from perception.errors import InvalidInputError
from perception.types import RgbdFrame, SupportPlane

SIDE = 64
CHANNELS = 6
CONTEXT = 2
_OPENING_RADIUS = 0.08  # of the morphological opening, relative to the square root of the mask's area
_MIN_CORE = 0.6  # smallest share of the mask's pixels in its core
_MARGIN = 1.35  # side of the crop over the longer side of the mask's bounding box
_HEIGHT_RANGE = 0.30  # [m] largest height above the plane in 8 bits
_DEPTH_RANGE = 0.20  # [m] largest deviation from the median depth in 8 bits


@dataclass(frozen=True)
class Crop:
    """The crop of one instance.

    Attributes:
        image: (SIDE, SIDE, 6) uint8: red, green, blue, mask (antialiased, 255 inside), height above the plane
            (0 to 0.3 m), depth relative to its median in the mask (-0.2 to 0.2 m). Where depth is missing,
            height is 0 and depth the median; outside the image everything is 0.
        context: (2,) log of the crop's side relative to 0.15 m, sine of the elevation of the view.
        heading: (3,) world direction in the plane that points up in the crop, the zero of relative yaw.
    """

    image: UInt8[np.ndarray, "side side 6"]
    context: Float[np.ndarray, "2"]
    heading: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class FrameGeometry:
    """Filtered depth and heights, shared by all crops of a frame.

    Attributes:
        planes: (H, W, 3) 1 where depth was measured, median-filtered depth in metres, height above the plane
            in metres; all 0 where depth is missing.
    """

    planes: Float[np.ndarray, "h w 3"]

    @property
    def depth(self) -> Float[np.ndarray, "h w"]:
        """Median-filtered depth in metres."""
        return self.planes[..., 1]

    def has_depth(self, mask: Bool[np.ndarray, "h w"]) -> bool:
        """Return whether the mask contains measured depth, which ``crop`` requires."""
        return bool((mask & (self.depth > 0)).any())


def frame_geometry(frame: RgbdFrame, plane: SupportPlane) -> FrameGeometry:
    """Return the frame's cleaned and filtered depth and heights."""
    depth = cv2.medianBlur(clean_frame(frame).depth, 5)
    measured = (depth > 0).astype(np.float32)
    return FrameGeometry(cv2.merge([measured, depth, height_image(frame, plane, depth) * measured]))


def crop(
    frame: RgbdFrame,
    mask: Bool[np.ndarray, "h w"],
    plane: SupportPlane,
    geometry: FrameGeometry | None = None,
) -> Crop:
    """Return the crop around a masked instance, rotated so that gravity points down.

    Args:
        frame: The image.
        mask: Pixels of the instance.
        plane: Support plane in the world frame.
        geometry: Result of ``frame_geometry`` for the frame; computed if None.

    Raises:
        InvalidInputError: The mask contains no measured depth.
    """
    geometry = geometry or frame_geometry(frame, plane)
    window = bounding_window(mask)
    depth = geometry.depth[window]
    inside = mask[window] & (depth > 0)
    if not inside.any():
        raise InvalidInputError("the mask contains no measured depth: skip instances without depth")
    median = float(np.median(depth[inside]))
    centre = _centre(frame, window, inside, depth)
    heading = view_heading(frame, plane, centre)
    A, side_pixels = _upright_warp(frame, mask[window], window, centre, heading)
    image = np.dstack([
        _resampled(frame.rgb, A), _resampled(mask.view(np.uint8) * np.uint8(255), A),
        *_geometry_channels(geometry, A, median),
    ])  # fmt: skip
    ray = centre - camera_pose(frame)[:3, 3]
    elevation = -(ray @ plane.normal) / np.linalg.norm(ray)
    side = side_pixels * median / np.sqrt(frame.intrinsics.fx * frame.intrinsics.fy)
    context = np.array([np.log(side / 0.15), elevation], dtype=np.float32)
    return Crop(image=image, context=context, heading=heading)


def stack_crops(crops: Sequence[Crop]) -> tuple[UInt8[np.ndarray, "n side side 6"], Float[np.ndarray, "n 2"]]:
    """Return the images and contexts of any number of crops as batches."""
    images = np.array([c.image for c in crops], np.uint8).reshape(-1, SIDE, SIDE, CHANNELS)
    return images, np.array([c.context for c in crops], np.float32).reshape(-1, CONTEXT)


def mask_core(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the largest component of the mask after a morphological opening.

    This removes thin parts, such as a strip along a neighbour's contour, but also handles: the crop for the
    class still shows them as context, the crop for the yaw needs the whole mask. If less than 60 % of the
    mask would remain, because the object itself is thin, the mask itself is returned.
    """
    size = np.count_nonzero(mask)
    radius = max(1, round(_OPENING_RADIUS * np.sqrt(size)))
    window = bounding_window(mask, margin=radius)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    opened = cv2.morphologyEx(mask[window].astype(np.uint8), cv2.MORPH_OPEN, disc)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    if count <= 1:
        return mask
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    if stats[largest, cv2.CC_STAT_AREA] < _MIN_CORE * size:
        return mask
    result = np.zeros_like(mask)
    result[window] = labels == largest
    return result


def _geometry_channels(
    geometry: FrameGeometry, A: Float[np.ndarray, "2 3"], median: float
) -> list[UInt8[np.ndarray, "side side"]]:
    """Return height and relative depth, each the mean of the measured pixels under a crop pixel."""
    share, depth, height = np.moveaxis(_resampled(geometry.planes, A, beyond=(1.0, 0.0, 0.0)), 2, 0)
    known, share = share > 0.05, np.maximum(share, 0.05)
    depth, height = depth / share, height / share
    up = np.where(known, np.clip(height / _HEIGHT_RANGE, 0, 1) * 255, 0)
    relative = np.clip((depth - median) / _DEPTH_RANGE * 0.5 + 0.5, 0, 1) * 255
    return [up.astype(np.uint8), np.where(known, relative, 127.0).astype(np.uint8)]


def _centre(
    frame: RgbdFrame,
    window: tuple[slice, slice],
    inside: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
) -> Float[np.ndarray, "3"]:
    """Return the centroid in the world of the window's points inside the mask."""
    v, u = np.nonzero(inside)
    z, k, T = depth[v, u].astype(np.float64), frame.intrinsics, camera_pose(frame)
    x = (u + window[1].start - k.cx) / k.fx * z
    y = (v + window[0].start - k.cy) / k.fy * z
    return T[:3, :3] @ (x.mean(), y.mean(), z.mean()) + T[:3, 3]


def _upright_warp(
    frame: RgbdFrame,
    mask: Bool[np.ndarray, "h w"],
    window: tuple[slice, slice],
    centre: Float[np.ndarray, "3"],
    heading: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "2 3"], float]:
    """Return (affine map from image pixels to crop pixels, side of the crop in image pixels).

    ``mask`` is the part of the mask in ``window``.
    """
    k, R = frame.intrinsics, camera_pose(frame)[:3, :3]
    # Image of the heading at the centre by the derivative of the projection, free of pixel rounding.
    x, y, z = R.T @ (centre - camera_pose(frame)[:3, 3])
    dx, dy, dz = R.T @ heading
    step = np.array([k.fx * (dx - x / z * dz), k.fy * (dy - y / z * dz)])
    up = step / np.linalg.norm(step)
    turn = np.array([[-up[1], up[0]], [-up[0], -up[1]]])  # rows: the crop's right and down in image axes

    outline = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
    corners = np.concatenate([contour[:, 0] for contour in outline])
    corners = (corners + np.array([window[1].start, window[0].start])) @ turn.T
    low, high = corners.min(0), corners.max(0)
    side = float(max((high - low).max() + 1, 8.0)) * _MARGIN
    scale = SIDE / side
    middle = (low + high) / 2
    offset = (SIDE - 1) / 2 - scale * middle
    return np.hstack([scale * turn, offset[:, None]]), side


def _resampled(
    image: Shaped[np.ndarray, "h w *c"], A: Float[np.ndarray, "2 3"], beyond: tuple[float, ...] = (0.0,) * 3
) -> Shaped[np.ndarray, "side side *c"]:
    """Return the image warped to the crop, antialiased by 4 x 4 supersampling where it shrinks.

    ``beyond`` is the value outside the image.
    """
    factor = 4 if np.linalg.norm(A[0, :2]) < 0.6 else 1
    fine = factor * A
    fine[:, 2] += (factor - 1) / 2  # pixel centres at integers in both images
    size = (SIDE * factor,) * 2
    warped = cv2.warpAffine(image, fine, size, flags=cv2.INTER_LINEAR, borderValue=beyond)
    return warped if factor == 1 else cv2.resize(warped, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
