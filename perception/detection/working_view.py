"""The scene network's input: a frame reduced to 320 pixels and rotated upright, with metric channels.

The network works in pixels; their metric meaning is kept beside the channels: the plan coordinates of every
pixel, along the image's right and away from the camera, and the size of a pixel at its point.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from perception.depth_cleaning import clean_frame
from perception.detection.geometry import camera_pose, height_image, linear_in_depth
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

LONGER_SIDE = 320
CHANNELS = 8
_TYPICAL_PIXEL = 0.002  # [m]
_MIN_DEPTH = 0.12  # [m] smaller depths are treated as missing


@dataclass(frozen=True)
class WorkingView:
    """Input channels of the scene network and the geometry that its outputs refer to.

    Attributes:
        channels: (h, w, 8) float32: red, green, blue in -0.5..0.5; height above the plane in units of 0.1 m
            and, clipped, of 0.01 m; whether depth was measured; log pixel size; sine of the ray's descent.
        plan: (h, w, 2) coordinates of each pixel's point along ``axes``, in metres.
        pixel: (h, w) size of a pixel at its point, perpendicular to the ray, in metres.
        height: (h, w) height above the plane, in metres.
        measured: (h, w) whether depth was measured; elsewhere it is that of the nearest measured pixel.
        axes: (2, 3) world directions in the plane: right in the rotated image, and away from the camera.
        turns: Counterclockwise quarter turns from the frame's image to this one.
    """

    channels: Float[np.ndarray, "h w 8"]
    plan: Float[np.ndarray, "h w 2"]
    pixel: Float[np.ndarray, "h w"]
    height: Float[np.ndarray, "h w"]
    measured: Bool[np.ndarray, "h w"]
    axes: Float[np.ndarray, "2 3"]
    turns: int


def downscale(frame: RgbdFrame) -> RgbdFrame:
    """Return the frame with its longer side reduced to at most ``LONGER_SIDE`` pixels.

    Depth is cleaned, median-filtered and resampled to the nearest pixel: no interpolation across
    discontinuities.
    """
    k = frame.intrinsics
    depth = cv2.medianBlur(clean_frame(frame).depth, 3)
    longer = max(k.width, k.height)
    if longer <= LONGER_SIDE:
        return RgbdFrame(frame.time, frame.rgb, depth, k, frame.T_world_camera)
    width, height = (max(1, round(side * LONGER_SIDE / longer)) for side in (k.width, k.height))
    sx, sy = width / k.width, height / k.height
    small = CameraIntrinsics(
        width, height, k.fx * sx, k.fy * sy, (k.cx + 0.5) * sx - 0.5, (k.cy + 0.5) * sy - 0.5
    )
    rgb = cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA)
    depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
    return RgbdFrame(frame.time, np.asarray(rgb, np.uint8), depth, small, frame.T_world_camera)


def quarter_turns(frame: RgbdFrame, plane: SupportPlane) -> int:
    """Return the counterclockwise quarter turns after which the plane's normal points up in the image."""
    right, down = (float(camera_pose(frame)[:3, axis] @ plane.normal) for axis in (0, 1))
    if np.hypot(right, down) < 0.35:  # from above, no direction is preferred
        return 0
    return round(float(np.arctan2(right, -down)) / (np.pi / 2)) % 4


def working_view(frame: RgbdFrame, plane: SupportPlane) -> WorkingView:
    """Return the network's input for a frame reduced by ``downscale``."""
    measured = frame.depth > _MIN_DEPTH
    depth = _filled(frame.depth, measured)
    height = height_image(frame, plane, depth)
    turns = quarter_turns(frame, plane)
    axes = _image_axes(frame, plane, turns)
    plan = np.stack(
        [slope * depth + np.float32(c) for slope, c in (linear_in_depth(frame, a) for a in axes)], -1
    )
    k = frame.intrinsics
    pixel = depth / np.float32(np.sqrt(k.fx * k.fy))
    descent = _descent(frame, plane)
    rgb = frame.rgb.astype(np.float32) / 255 - 0.5
    fine = np.clip(height / 0.01, -2, 3)
    coarse = np.clip(height / 0.1, -1, 4)
    size = np.clip(np.log(np.maximum(pixel, 1e-5) / _TYPICAL_PIXEL), -2, 3)
    channels = np.dstack([rgb, coarse, fine, measured, size, descent]).astype(np.float32)

    def rotated(image: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(image, turns))

    return WorkingView(
        rotated(channels),
        rotated(plan),
        rotated(pixel),
        rotated(height),
        rotated(measured),
        axes,
        turns,
    )


def _filled(depth: Float[np.ndarray, "h w"], measured: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Fill missing depth from the nearest measured pixel; 1 m if the image has no measurement."""
    if measured.all():
        return depth
    if not measured.any():
        return np.ones_like(depth)
    return fill_from_nearest(depth, measured)[0]


def fill_from_nearest(
    values: Shaped[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> tuple[Shaped[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Return for each pixel the value of the nearest known pixel and its distance in pixels.

    At least one pixel must be known.
    """
    distance, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(nearest, dtype=np.int32)
    table = np.zeros(int(label.max()) + 1, values.dtype)
    table[label[known]] = values[known]
    return table[label], np.asarray(distance, dtype=np.float32)


def _image_axes(frame: RgbdFrame, plane: SupportPlane, turns: int) -> Float[np.ndarray, "2 3"]:
    """Return the plane's directions to the right in the rotated image and away from the camera."""
    R = camera_pose(frame)[:3, :3]
    right = (R[:, 0], R[:, 1], -R[:, 0], -R[:, 1])[turns]
    right = right - (right @ plane.normal) * plane.normal
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(plane.normal, right)])


def _descent(frame: RgbdFrame, plane: SupportPlane) -> Float[np.ndarray, "h w"]:
    """Return the sine of the angle at which each pixel's ray descends towards the plane."""
    slope, _ = linear_in_depth(frame, plane.normal)  # change of height per depth along each ray
    k = frame.intrinsics
    x = (np.arange(k.width, dtype=np.float32) - k.cx) / k.fx
    y = (np.arange(k.height, dtype=np.float32) - k.cy) / k.fy
    return -slope / np.sqrt(1 + np.add.outer(y**2, x**2)).astype(np.float32)
