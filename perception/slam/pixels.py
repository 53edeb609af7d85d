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
        per_object: pixels of an object and its ring together.
        on_plane: pixels of the plane.
        band: half width of the border that is left out [pixel].
        ring: how far from the mask its ring reaches [pixel].
        plane_height: what is seen lower than this above the plane lies on it [m].
        background_weight: of a ring's pixel; one of the object has 1.
    """

    per_object: int = 300
    on_plane: int = 300
    band: float = 2.0
    ring: float = 8.0
    plane_height: float = 0.012
    background_weight: float = 0.2


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
    us, vs, owners, on = [], [], [], []
    for label, landmark in landmark_of.items():
        own = is_object & (labels == label)
        depths = frame.depth[own]
        far = float(np.quantile(depths[:: max(1, len(depths) // 200)], 0.98)) if len(depths) else np.inf
        around = ring & (owner == label) & (low | (frame.depth > far + 0.03))
        for chosen, is_on, count in (
            (own, True, config.per_object * 2 // 3),
            (around, False, config.per_object // 3),
        ):
            v, u = thinned(chosen, count)
            us.append(u)
            vs.append(v)
            owners.append(np.full(len(u), landmark))
            on.append(np.full(len(u), is_on))
    u, v = (np.concatenate(a) if a else np.zeros(0, np.int64) for a in (us, vs))
    pv, pu = thinned(outside & low & (distance > 2 * config.band), config.on_plane)
    plane_points = pixel_rays(frame, pu, pv) * frame.depth[pv, pu][:, None].astype(np.float64)
    return TrackingPixels(
        directions=pixel_rays(frame, u, v),
        owner=np.concatenate(owners) if owners else np.zeros(0, np.int64),
        is_object=np.concatenate(on) if on else np.zeros(0, bool),
        depth=frame.depth[v, u],
        plane_points=plane_points,
    )


def thinned(chosen: Bool[np.ndarray, "h w"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of about ``count`` of the chosen pixels, evenly in scan order on a jittered grid."""
    flat = np.flatnonzero(chosen)
    if len(flat) > count:
        flat = flat[np.linspace(0, len(flat) - 1, count).astype(np.int64)]
    return np.unravel_index(flat, chosen.shape)  # type: ignore[return-value]
