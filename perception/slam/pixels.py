"""Which pixels of a frame speak for the camera's pose: those of objects, rings around them, and the plane.

Masks come as one label image. A band along every border, where masks are wrong first, says nothing. A pixel
of a ring must miss its object, so its target is the escape depth; it counts only where something is seen
that lies on the plane, or clearly behind the object: what else stands there may hide it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from perception.detection.geometry import height_image
from perception.inference.observation import pixel_rays
from perception.types import ObjectDetection, RgbdFrame, SupportPlane

NONE = 0  # label of pixels of no mask; detection k has label k + 1


@dataclass(frozen=True)
class SelectionConfig:
    """How many pixels, and which.

    Attributes:
        on_object, in_ring: pixels of an object and of its ring.
        on_plane: pixels of the plane.
        band: half width of the border that is left out [pixel].
        ring: how far from the mask its ring reaches [pixel].
        plane_height: what is seen lower than this above the plane lies on it [m].
    """

    on_object: int = 200
    in_ring: int = 100
    on_plane: int = 300
    band: float = 2.0
    ring: float = 8.0
    plane_height: float = 0.012


@dataclass(frozen=True)
class TrackingPixels:
    """Pixels chosen from one frame.

    Attributes:
        directions: (n, 3) of the objects' pixels, z = 1.
        owner: (n,) id of the landmark that each speaks for.
        is_object: (n,) whether it lies in the mask; otherwise in the ring.
        depth: (n,) measured [m].
        plane_points: (m, 3) measured points of the plane in the camera's frame [m].
    """

    directions: Float[np.ndarray, "n 3"]
    owner: Int[np.ndarray, "n"]
    is_object: Bool[np.ndarray, "n"]
    depth: Float[np.ndarray, "n"]
    plane_points: Float[np.ndarray, "m 3"]


def label_image(detections: Sequence[ObjectDetection], shape: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """Detection k as label k + 1; where masks overlap the smaller one wins."""
    labels = np.zeros(shape, np.uint8)
    for k in sorted(range(min(len(detections), 255)), key=lambda k: -int(detections[k].mask.sum())):
        labels[detections[k].mask] = k + 1
    return labels


def select_pixels(
    frame: RgbdFrame,
    labels: UInt8[np.ndarray, "h w"],
    landmark_of: Mapping[int, int],
    T_world_camera: Float[np.ndarray, "4 4"],
    plane: SupportPlane,
    config: SelectionConfig,
) -> TrackingPixels:
    """Chooses pixels evenly over the image.

    Args:
        frame: depth and intrinsics; its own pose is not looked at.
        labels: the masks.
        landmark_of: label to landmark, of those masks that are associated.
        T_world_camera: about where the camera is, good enough to tell the plane from what stands on it.
        plane: in the world.
        config: how many.
    """
    posed = RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics, T_world_camera)
    height = height_image(posed, plane)
    valid = frame.depth > 0
    low = valid & (np.abs(height) < config.plane_height)
    distance, nearest = cv2.distanceTransformWithLabels(
        (labels == NONE).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner_of_nearest = np.zeros(int(nearest.max()) + 1, np.uint8)
    inside = labels != NONE
    owner_of_nearest[nearest[inside]] = labels[inside]
    owner = np.where(inside, labels, owner_of_nearest[nearest])
    kernel = np.ones((2 * int(config.band) + 1,) * 2, np.uint8)
    core = cv2.erode(labels, kernel) == cv2.dilate(labels, kernel)
    is_object = inside & core & valid
    outside = valid & ~inside & (distance > config.band)
    ring = outside & (distance <= config.ring)
    flat_depth, flat_low = frame.depth.ravel(), low.ravel()
    inner, around = _by_label(is_object, owner), _by_label(ring, owner)
    chosen, owners, on = [], [], []
    for label, landmark in landmark_of.items():
        own = inner.get(label, _NOTHING)
        far = float(np.quantile(flat_depth[_evenly(own, 100)], 0.98)) if len(own) else np.inf
        beside = around.get(label, _NOTHING)
        beside = beside[flat_low[beside] | (flat_depth[beside] > far + BEHIND)]
        for pixels, is_on in (
            (_evenly(own, config.on_object), True),
            (_evenly(beside, config.in_ring), False),
        ):
            chosen.append(pixels)
            owners.append(np.full(len(pixels), landmark))
            on.append(np.full(len(pixels), is_on))
    v, u = np.divmod(np.concatenate([_NOTHING, *chosen]), labels.shape[1])
    table = outside & low & (distance > 2 * config.band)
    pv, pu = np.divmod(_evenly(np.flatnonzero(table), config.on_plane), labels.shape[1])
    plane_points = pixel_rays(frame, pu, pv) * frame.depth[pv, pu][:, None].astype(np.float64)
    return TrackingPixels(
        directions=pixel_rays(frame, u, v),
        owner=np.concatenate([_NOTHING, *owners]),
        is_object=np.concatenate([np.zeros(0, bool), *on]),
        depth=frame.depth[v, u],
        plane_points=plane_points,
    )


_NOTHING = np.zeros(0, np.int64)
BEHIND = 0.03  # [m] what lies this far behind an object does not hide it


def _by_label(chosen: Bool[np.ndarray, "h w"], labels: UInt8[np.ndarray, "h w"]) -> dict[int, np.ndarray]:
    """The chosen pixels of each label, as flat indices in scan order."""
    flat = np.flatnonzero(chosen)
    label = labels.ravel()[flat]
    order = np.argsort(label, kind="stable")
    flat, label = flat[order], label[order]
    starts = np.flatnonzero(np.diff(label.astype(np.int64), prepend=-1))
    return {int(label[start]): part for start, part in zip(starts, np.split(flat, starts[1:]))}


def _evenly(pixels: Int[np.ndarray, "n"], count: int) -> Int[np.ndarray, "m"]:
    """At most ``count`` of them, evenly in their order."""
    if len(pixels) <= count:
        return pixels
    return pixels[(np.arange(count) * (len(pixels) / count)).astype(np.int64)]
