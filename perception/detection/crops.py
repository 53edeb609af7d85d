"""Gravity-upright square crops about an instance, what the class and yaw networks look at.

Channels (SIDE x SIDE each): RGB, the mask, the height above the support plane, the depth relative to the
instance's median. All but the mask show the surroundings too: a mask that lost a handle or took in a piece of
a neighbour misleads nobody who sees what is there, and what ends at an occluder or at the image's border does
not end there. Two numbers beside them say what the picture cannot: the crop's side in metres and the
elevation it was seen from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from perception.detection.geometry import camera_pose, height_image, view_heading, window_of
from perception.errors import InvalidInputError
from perception.types import RgbdFrame, SupportPlane

SIDE = 64
CHANNELS = 6
CONTEXT = 2
_THIN = 0.08  # radius of what counts as thin, as a share of the root of the mask's area
_CORE = 0.6  # of a mask's pixels at least are its core
_MARGIN = 1.35  # side of the crop over the longer side of the mask's box
_HEIGHT_RANGE = 0.30  # [m] above the plane that 8 bits cover
_DEPTH_RANGE = 0.20  # [m] to either side of the median depth that 8 bits cover


@dataclass(frozen=True)
class Crop:
    """One instance, cut out.

    Attributes:
        image: (SIDE, SIDE, 6) uint8: red, green, blue, mask (0 or 255, between along the edge), height above
            the plane (0 to 0.3 m), depth minus its median in the mask (-0.2 to 0.2 m). Where no depth was
            measured the height is 0 and the depth the median; beyond the image's border everything is 0.
        context: (2,) log of the crop's side in [m] over 0.15 m, sine of the elevation of the view.
        heading: (3,) world direction in the plane that points up in the crop; yaw is counted from it.
    """

    image: UInt8[np.ndarray, "side side 6"]
    context: Float[np.ndarray, "2"]
    heading: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class FrameGeometry:
    """What all crops of one frame share.

    Attributes:
        planes: (H, W, 3) 1 where depth was measured, the median-filtered depth in [m], the height above the
            plane in [m]; all 0 elsewhere.
    """

    planes: Float[np.ndarray, "h w 3"]

    @property
    def depth(self) -> Float[np.ndarray, "h w"]:
        return self.planes[..., 1]

    def seen(self, mask: Bool[np.ndarray, "h w"]) -> bool:
        """Whether any depth was measured in the mask: what ``crop`` needs."""
        return bool((mask & (self.depth > 0)).any())


def frame_geometry(frame: RgbdFrame, plane: SupportPlane) -> FrameGeometry:
    """The frame's filtered depth and heights."""
    depth = cv2.medianBlur(np.ascontiguousarray(frame.depth), 5)
    measured = (depth > 0).astype(np.float32)
    return FrameGeometry(cv2.merge([measured, depth, height_image(frame, plane, depth) * measured]))


def crop(
    frame: RgbdFrame,
    mask: Bool[np.ndarray, "h w"],
    plane: SupportPlane,
    geometry: FrameGeometry | None = None,
) -> Crop:
    """Cut the surroundings of the masked instance out of the frame, turned so that gravity points down.

    Args:
        geometry: the frame's, where the caller has it already (``frame_geometry``).

    Raises:
        InvalidInputError: the mask holds no measured depth.
    """
    geometry = geometry or frame_geometry(frame, plane)
    window = window_of(mask)
    depth = geometry.depth[window]
    inside = mask[window] & (depth > 0)
    if not inside.any():
        raise InvalidInputError("cannot crop an instance without a single measured depth pixel in its mask")
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


def stacked(crops: Sequence[Crop]) -> tuple[UInt8[np.ndarray, "n side side 6"], Float[np.ndarray, "n 2"]]:
    """Images and contexts of crops as the networks take them; there may be none."""
    images = np.array([c.image for c in crops], np.uint8).reshape(-1, SIDE, SIDE, CHANNELS)
    return images, np.array([c.context for c in crops], np.float32).reshape(-1, CONTEXT)


def core(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The mask's largest piece once all that is thin is gone, such as an arm along a neighbour's edge.

    A morphological opening. Handles go, too: for the class, which the surroundings tell of, not for the yaw.
    A mask that would lose too much, because the thing itself is thin, stays as it is.
    """
    size = np.count_nonzero(mask)
    radius = max(1, round(_THIN * np.sqrt(size)))
    window = window_of(mask, margin=radius)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    opened = cv2.morphologyEx(mask[window].astype(np.uint8), cv2.MORPH_OPEN, disc)
    count, numbers, pieces, _ = cv2.connectedComponentsWithStats(opened)
    if count <= 1:
        return mask
    largest = 1 + int(pieces[1:, cv2.CC_STAT_AREA].argmax())
    if pieces[largest, cv2.CC_STAT_AREA] < _CORE * size:
        return mask
    result = np.zeros_like(mask)
    result[window] = numbers == largest
    return result


def _geometry_channels(
    geometry: FrameGeometry, A: Float[np.ndarray, "2 3"], median: float
) -> list[UInt8[np.ndarray, "side side"]]:
    """Height and relative depth; the mean of what was measured near each pixel."""
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
    """Centroid in the world of the window's points inside the mask."""
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
    """(affine map from the image's pixels to the crop's, the crop's side in image pixels).

    ``mask`` is what lies in ``window`` of the image.
    """
    k, R = frame.intrinsics, camera_pose(frame)[:3, :3]
    # The image of a step along the heading, from the projection's derivative (rounding has no say here).
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
    """The image warped to the crop; strongly shrunk ones by way of four times the pixels, then averaged.

    ``beyond`` is what lies beyond the image's border.
    """
    factor = 4 if np.linalg.norm(A[0, :2]) < 0.6 else 1
    fine = factor * A
    fine[:, 2] += (factor - 1) / 2  # pixel centres at integers in both images
    size = (SIDE * factor,) * 2
    warped = cv2.warpAffine(image, fine, size, flags=cv2.INTER_LINEAR, borderValue=beyond)
    return warped if factor == 1 else cv2.resize(warped, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
