"""Which pixels of a frame speak for the camera's pose: those of objects, rings around them, and the plane.

Masks come as one label image. A band along every border, where masks are wrong first, says nothing. A pixel
of a ring must miss its object, so its target is the escape depth; it counts only where something is seen
that lies on the plane, or clearly behind the object: what else stands there may hide it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from perception.detection.geometry import height_image
from perception.geometry import invert, transform_points
from perception.inference.observation import pixel_rays
from perception.slam.keyframes import Keyframe, with_pose
from perception.slam.landmarks import LandmarkMap
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
        width: of the image that pixels are chosen from; of larger ones every second, third, ... is taken.
        plane_height: what is seen lower than this above the plane lies on it [m].
    """

    on_object: int = 200
    in_ring: int = 100
    on_plane: int = 300
    band: float = 2.0
    ring: float = 8.0
    width: int = 320
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

    def only(self, chosen: Bool[np.ndarray, "n"]) -> TrackingPixels:
        """Without the others of the objects' pixels."""
        names = ("directions", "owner", "is_object", "depth")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


def label_image(detections: Sequence[ObjectDetection], shape: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """Detection k as label k + 1; where masks overlap the smaller one wins."""
    labels = np.zeros(shape, np.uint8)
    for k in sorted(range(min(len(detections), 255)), key=lambda k: -np.count_nonzero(detections[k].mask)):
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
    pitch = max(1, round(labels.shape[1] / config.width))
    labels, depth = labels[::pitch, ::pitch], np.ascontiguousarray(frame.depth[::pitch, ::pitch])
    height = height_image(with_pose(frame, T_world_camera), plane)[::pitch, ::pitch]
    valid, inside = depth > 0, labels != NONE
    low = valid & (np.abs(height) < config.plane_height)
    band, ring = int(config.band), int(config.ring)
    grown = {reach: cv2.dilate(labels, _disc(reach)) for reach in (band, 2 * band, ring)}
    is_object = inside & valid & (cv2.erode(labels, _disc(band)) == grown[band])
    is_ring = valid & (grown[band] == NONE) & (grown[ring] != NONE)
    inner, around = _by_label(is_object, labels), _by_label(is_ring, grown[ring])
    flat_depth, flat_low = depth.ravel(), low.ravel()
    chosen, owners, on = [], [], []
    for label, landmark in landmark_of.items():
        own = _evenly(inner.get(label, _NOTHING), config.on_object)
        far = np.sort(flat_depth[own])[int(0.98 * len(own))] if len(own) else np.inf
        beside = around.get(label, _NOTHING)
        beside = _evenly(beside[flat_low[beside] | (flat_depth[beside] > far + BEHIND)], config.in_ring)
        for pixels, is_on in ((own, True), (beside, False)):
            chosen.append(pixels)
            owners.append(np.full(len(pixels), landmark))
            on.append(np.full(len(pixels), is_on))
    v, u = np.divmod(np.concatenate([_NOTHING, *chosen]), labels.shape[1])
    table = (low & (grown[2 * band] == NONE))[::2, ::2]
    pv, pu = np.divmod(_evenly(np.flatnonzero(table), config.on_plane), table.shape[1])
    pv, pu = 2 * pv, 2 * pu
    return TrackingPixels(
        directions=pixel_rays(frame, pitch * u, pitch * v),
        owner=np.concatenate([_NOTHING, *owners]),
        is_object=np.concatenate([np.zeros(0, bool), *on]),
        depth=depth[v, u],
        plane_points=pixel_rays(frame, pitch * pu, pitch * pv) * depth[pv, pu][:, None].astype(np.float64),
    )


@cache
def _disc(reach: int) -> UInt8[np.ndarray, "k k"]:
    """The pixels no farther than ``reach`` from the middle one."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)


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


def in_known_parts(
    pixels: TrackingPixels,
    world: LandmarkMap,
    keyframes: Sequence[Keyframe],
    T_world_camera: Float[np.ndarray, "4 4"],
) -> Bool[np.ndarray, "n"]:
    """Which pixels show, or pass beside, a part of their landmark that a keyframe had in view.

    What the image border cut off when a landmark was made is a guess; coming into view, it would drag the
    camera along.
    """
    known = np.ones(len(pixels.owner), bool)
    for one in np.unique(pixels.owner):
        landmark = world.landmarks.get(int(one))
        if landmark is None or not landmark.cut:
            continue
        own = np.flatnonzero(pixels.owner == one)
        depth = pixels.depth[own].astype(np.float64)
        middle = transform_points(invert(T_world_camera), landmark.state.pose.translation[None])[0, 2]
        depth[~pixels.is_object[own]] = middle  # a ray beside it
        points = transform_points(T_world_camera, pixels.directions[own] * depth[:, None])
        views = [key.has_in_view(points) for key in keyframes if one in key.landmarks]
        known[own] = np.any(views, axis=0) if views else True
    return known
