"""A frame as the scene network sees it: about 320 pixels wide, gravity downwards to a quarter turn, metric.

The network works in pixels; what they mean in metres stands beside them: each pixel's place in the plane
(axes along the image's right and away from the camera) and the size of a pixel there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from perception.detection.geometry import camera_pose, height_image, linear_in_depth
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

LONGER_SIDE = 320
CHANNELS = 8
_TYPICAL_PIXEL = 0.002  # [m]
_NEAR = 0.12  # [m], depths below are no measurements of a table


@dataclass(frozen=True)
class WorkingView:
    """What goes into the network, and what its answers mean.

    Attributes:
        channels: (h, w, 8) float32: red, green, blue about 0; height above the plane, coarse (0.1 m) and fine
            (0.01 m, cut off); whether depth was measured; log of the pixel's size; sine of the ray's descent.
        plan: (h, w, 2) place of each pixel's point along ``axes`` in [m].
        pixel: (h, w) size of a pixel at its point, square to the ray, in [m].
        height: (h, w) above the plane in [m].
        measured: (h, w) whether the depth is the camera's own; elsewhere it is the nearest measured one.
        axes: (2, 3) world directions in the plane: right in the turned image, and away from the camera.
        turns: quarter turns (counterclockwise) from the frame's image to this one.
    """

    channels: Float[np.ndarray, "h w 8"]
    plan: Float[np.ndarray, "h w 2"]
    pixel: Float[np.ndarray, "h w"]
    height: Float[np.ndarray, "h w"]
    measured: Bool[np.ndarray, "h w"]
    axes: Float[np.ndarray, "2 3"]
    turns: int


def reduced(frame: RgbdFrame) -> RgbdFrame:
    """The frame with its longer side ``LONGER_SIDE`` pixels long, if it is longer; depth is never mixed."""
    k = frame.intrinsics
    depth = cv2.medianBlur(np.ascontiguousarray(frame.depth), 3)
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
    """How often the image must be turned by 90 degrees counterclockwise so that up is rather upwards."""
    right, down = (float(camera_pose(frame)[:3, axis] @ plane.normal) for axis in (0, 1))
    if np.hypot(right, down) < 0.35:  # seen from above every way up is as good
        return 0
    return round(float(np.arctan2(right, -down)) / (np.pi / 2)) % 4


def working_view(frame: RgbdFrame, plane: SupportPlane) -> WorkingView:
    """The network's view of a frame that is ``reduced`` already."""
    measured = frame.depth > _NEAR
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

    def turned(image: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(image, turns))

    return WorkingView(
        turned(channels), turned(plan), turned(pixel), turned(height), turned(measured), axes, turns
    )


def _filled(depth: Float[np.ndarray, "h w"], measured: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Depth with the nearest measurement where there is none; 1 m where there is none at all."""
    if measured.all():
        return depth
    if not measured.any():
        return np.ones_like(depth)
    return spread_from(depth, measured)[0]


def spread_from(
    values: Shaped[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> tuple[Shaped[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """At each pixel the value of the nearest known one, and how far that is in pixels; one must be known."""
    distance, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    number = np.asarray(nearest, dtype=np.int32)
    table = np.zeros(int(number.max()) + 1, values.dtype)
    table[number[known]] = values[known]
    return table[number], np.asarray(distance, dtype=np.float32)


def _image_axes(frame: RgbdFrame, plane: SupportPlane, turns: int) -> Float[np.ndarray, "2 3"]:
    """The plane's directions to the right in the turned image, and away from the camera."""
    R = camera_pose(frame)[:3, :3]
    right = (R[:, 0], R[:, 1], -R[:, 0], -R[:, 1])[turns]
    right = right - (right @ plane.normal) * plane.normal
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(plane.normal, right)])


def _descent(frame: RgbdFrame, plane: SupportPlane) -> Float[np.ndarray, "h w"]:
    """Sine of the angle at which each pixel's ray descends towards the plane."""
    slope, _ = linear_in_depth(frame, plane.normal)  # height lost per depth along each ray
    k = frame.intrinsics
    x = (np.arange(k.width, dtype=np.float32) - k.cx) / k.fx
    y = (np.arange(k.height, dtype=np.float32) - k.cy) / k.fy
    return -slope / np.sqrt(1 + np.add.outer(y**2, x**2)).astype(np.float32)
