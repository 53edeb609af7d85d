"""Selection of the pixels that camera tracking uses: of objects, of rings around them, and of the plane.

Pixels in a band along the borders of masks, where segmentation errors concentrate, are excluded. The ray of a
ring pixel must miss its object, so its target is the escape depth; it is used only if its measurement lies on
the plane or clearly behind the object, since anything else may occlude the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from perception.detection.geometry import height_image
from perception.geometry import invert, transform_points
from perception.inference.observation import pixel_rays
from perception.slam.keyframes import Keyframe
from perception.slam.labelled_frame import BACKGROUND, LabelledFrame
from perception.slam.landmarks import LandmarkMap
from perception.types import SupportPlane

BEHIND = 0.03  # [m] depth behind an object beyond which a measurement cannot be of an occluder
_FAR_QUANTILE = 0.98  # of an object's measured depths: its farthest visible part
_PLANE_PITCH = 2  # subsampling of the plane's pixels
_NO_PIXELS = np.zeros(0, np.int64)


@dataclass(frozen=True)
class PixelSelectionConfig:
    """Number and location of the pixels.

    Attributes:
        object_pixels: Largest number of pixels of one object.
        ring_pixels: Largest number of pixels of one object's ring.
        plane_pixels: Largest number of pixels of the plane.
        border_band: Half width of the excluded band along mask borders, in pixels.
        ring_width: Distance from the mask up to which its ring extends, in pixels.
        image_width: Width to which larger images are subsampled, in pixels.
        max_plane_height: Distance from the plane below which a point lies on it, in metres.
    """

    object_pixels: int = 200
    ring_pixels: int = 100
    plane_pixels: int = 300
    border_band: int = 2
    ring_width: int = 8
    image_width: int = 320
    max_plane_height: float = 0.012


@dataclass(frozen=True)
class TrackingPixels:
    """Pixels selected from one frame.

    Attributes:
        directions: Back-projected object and ring pixels in the camera frame, z = 1.
        landmark_ids: Id of the landmark that each constrains.
        is_object: Whether it is inside the mask; otherwise it belongs to the ring.
        depth: Measured depth, in metres.
        plane_points: Measured points of the plane in the camera frame, in metres.
    """

    directions: Float[np.ndarray, "n 3"]
    landmark_ids: Int[np.ndarray, "n"]
    is_object: Bool[np.ndarray, "n"]
    depth: Float[np.ndarray, "n"]
    plane_points: Float[np.ndarray, "m 3"]

    def subset(self, chosen: Bool[np.ndarray, "n"]) -> TrackingPixels:
        """Return the chosen object and ring pixels, with all plane points."""
        names = ("directions", "landmark_ids", "is_object", "depth")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


def select_pixels(
    view: LabelledFrame, plane: SupportPlane, config: PixelSelectionConfig = PixelSelectionConfig()
) -> TrackingPixels:
    """Select pixels evenly over the associated masks, their rings and the plane.

    Args:
        view: Depth, masks and their association, with a pose accurate enough to separate the plane from the
            objects on it.
        plane: Support plane in the world frame.
        config: Number and location of the pixels.
    """
    pitch = max(1, round(view.labels.shape[1] / config.image_width))
    labels = view.labels[::pitch, ::pitch]
    depth = np.ascontiguousarray(view.frame.depth[::pitch, ::pitch])
    height = height_image(view.frame, plane)[::pitch, ::pitch]
    valid, inside = depth > 0, labels != BACKGROUND
    on_plane = valid & (np.abs(height) < config.max_plane_height)
    band, ring = config.border_band, config.ring_width
    grown = {radius: cv2.dilate(labels, _disc(radius)) for radius in (band, 2 * band, ring)}
    is_object = inside & valid & (cv2.erode(labels, _disc(band)) == grown[band])
    is_ring = valid & (grown[band] == BACKGROUND) & (grown[ring] != BACKGROUND)
    inner, around = _by_label(is_object, labels), _by_label(is_ring, grown[ring])
    flat_depth, flat_on_plane = depth.ravel(), on_plane.ravel()
    chosen, ids, on_object = [], [], []
    for label, id in view.landmark_of.items():
        own = _evenly(inner.get(label, _NO_PIXELS), config.object_pixels)
        far = np.sort(flat_depth[own])[int(_FAR_QUANTILE * len(own))] if len(own) else np.inf
        beside = around.get(label, _NO_PIXELS)
        unoccluding = flat_on_plane[beside] | (flat_depth[beside] > far + BEHIND)
        beside = _evenly(beside[unoccluding], config.ring_pixels)
        for pixels, is_on in ((own, True), (beside, False)):
            chosen.append(pixels)
            ids.append(np.full(len(pixels), id))
            on_object.append(np.full(len(pixels), is_on))
    v, u = np.divmod(np.concatenate([_NO_PIXELS, *chosen]), labels.shape[1])
    table = (on_plane & (grown[2 * band] == BACKGROUND))[::_PLANE_PITCH, ::_PLANE_PITCH]
    pv, pu = np.divmod(_evenly(np.flatnonzero(table), config.plane_pixels), table.shape[1])
    pv, pu = _PLANE_PITCH * pv, _PLANE_PITCH * pu
    plane_rays = pixel_rays(view.frame, pitch * pu, pitch * pv)
    return TrackingPixels(
        directions=pixel_rays(view.frame, pitch * u, pitch * v),
        landmark_ids=np.concatenate([_NO_PIXELS, *ids]),
        is_object=np.concatenate([np.zeros(0, bool), *on_object]),
        depth=depth[v, u],
        plane_points=plane_rays * depth[pv, pu][:, None].astype(np.float64),
    )


@cache
def _disc(radius: int) -> UInt8[np.ndarray, "k k"]:
    """Return a disc as structuring element."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)


def _by_label(
    chosen: Bool[np.ndarray, "h w"], labels: UInt8[np.ndarray, "h w"]
) -> dict[int, Int[np.ndarray, "_n"]]:
    """Return the chosen pixels of each label as flat indices in scan order."""
    flat = np.flatnonzero(chosen)
    label = labels.ravel()[flat]
    order = np.argsort(label, kind="stable")
    flat, label = flat[order], label[order]
    starts = np.flatnonzero(np.diff(label.astype(np.int64), prepend=-1))
    return {int(label[start]): part for start, part in zip(starts, np.split(flat, starts[1:]))}


def _evenly(pixels: Int[np.ndarray, "n"], count: int) -> Int[np.ndarray, "m"]:
    """Return at most ``count`` of the pixels, evenly spaced in their order."""
    if len(pixels) <= count:
        return pixels
    return pixels[(np.arange(count) * (len(pixels) / count)).astype(np.int64)]


def in_observed_parts(
    pixels: TrackingPixels,
    world: LandmarkMap,
    keyframes: Sequence[Keyframe],
    T_world_camera: Float[np.ndarray, "4 4"],
) -> Bool[np.ndarray, "n"]:
    """Return which pixels show a part of their landmark that some keyframe had in view.

    The shape of a truncated landmark beyond the image border is extrapolated by the prior; tracking it would
    bias the camera pose. Pixels of landmarks that are not truncated are all accepted.

    Args:
        pixels: Pixels of the frame; a ring pixel is placed at the depth of its landmark's origin.
        world: The map.
        keyframes: All keyframes.
        T_world_camera: Pose of the frame.
    """
    observed = np.ones(len(pixels.landmark_ids), bool)
    for id in np.unique(pixels.landmark_ids):
        landmark = world.landmarks.get(int(id))
        if landmark is None or not landmark.truncated:
            continue
        own = np.flatnonzero(pixels.landmark_ids == id)
        depth = pixels.depth[own].astype(np.float64)
        origin = transform_points(invert(T_world_camera), landmark.state.pose.translation[None])[0]
        depth[~pixels.is_object[own]] = origin[2]
        points = transform_points(T_world_camera, pixels.directions[own] * depth[:, None])
        views = [key.has_in_view(points) for key in keyframes if id in key.landmark_ids]
        observed[own] = np.any(views, axis=0) if views else True
    return observed
