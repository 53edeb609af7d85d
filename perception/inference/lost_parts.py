"""Parts of objects that their masks lack, such as the handle of a mug upside down beside another object.

The networks cut off what they do not know, or give it to a neighbour. Measured points that no shape explains
and that continue an object in an image are taken to be parts of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.depth_cleaning import beside_jumps, clean_frame
from perception.detection.geometry import bounding_window, height_image, points_of
from perception.metrics import SurfaceSamples
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

Rows = Sequence[Sequence[ObjectDetection]]

FAR = 0.006  # [m] from the surfaces of all shapes, from which on a measured point is unexplained
ABOVE = 0.008  # [m] over the support
REACH = 0.7  # how far from a mask its parts are looked for, in its longer sides
SMALLEST, LARGEST = 0.01, 0.6  # pixels of a part relative to those of the mask
SAME = 0.02  # [m] between points of one part in different views, which may show its two sides
MIN_PIXELS = 25
JUMP = 0.02  # [m] of depth between neighbouring pixels of one surface
SAMPLES = 8000


def with_lost_parts(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    ids: Sequence[int],
    plane: SupportPlane,
) -> dict[int, list[Bool[np.ndarray, "h w"] | None]]:
    """Return the masks of objects with the parts that they lack, None where none shows, by id.

    Objects whose masks lack nothing are left out.

    Args:
        frames: Images with camera poses.
        rows: Associated detections of each frame.
        estimates: Estimates of all objects, by id.
        ids: Objects whose parts are looked for.
        plane: Support plane.
    """
    rng = np.random.default_rng(0)
    points = [SurfaceSamples.of(e.mesh_world, rng, SAMPLES).points for e in estimates.values()]
    surfaces = KDTree(np.concatenate([np.full((1, 3), 1e6), *points]))
    found: dict[int, list[Bool[np.ndarray, "h w"] | None]] = {id: [None] * len(frames) for id in ids}
    cleaned = [clean_frame(frame) for frame in frames]
    parts: dict[int, dict[int, Bool[np.ndarray, "h w"]]] = {id: {} for id in ids}
    for k, (frame, row) in enumerate(zip(cleaned, rows, strict=True)):
        for detection in row:
            if detection.instance_id in found:
                others = [other.mask for other in row if other is not detection]
                part = _lost_part(frame, detection.mask, others, surfaces, plane)
                if part.any():
                    parts[detection.instance_id][k] = part
                    found[detection.instance_id][k] = detection.mask
    for id, masks in found.items():
        agreed = _agreed(cleaned, parts[id])
        found[id] = [
            mask | agreed[k] if mask is not None and k in agreed else None for k, mask in enumerate(masks)
        ]
    return {id: masks for id, masks in found.items() if any(mask is not None for mask in masks)}


def _agreed(
    frames: Sequence[RgbdFrame], parts: Mapping[int, Bool[np.ndarray, "h w"]]
) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Return the pixels of parts, by view, near which at least half of the other views show a part as well.

    What lies beside an object seems to continue it in some views only.
    """
    clouds = {k: points_of(frames[k], part) for k, part in parts.items()}
    trees = {k: KDTree(cloud) for k, cloud in clouds.items() if len(cloud)}
    agreed: dict[int, Bool[np.ndarray, "h w"]] = {}
    for k, part in parts.items():
        if k not in trees:
            continue
        others = [
            tree.query(clouds[k], distance_upper_bound=SAME)[0] < SAME for j, tree in trees.items() if j != k
        ]
        kept = part.copy()
        kept[part & (frames[k].depth > 0)] = np.mean(others, axis=0) >= 0.5 if others else True
        if kept.sum() >= MIN_PIXELS:
            agreed[k] = kept
    return agreed


def _lost_part(
    frame: RgbdFrame,
    mask: Bool[np.ndarray, "h w"],
    others: Sequence[Bool[np.ndarray, "h w"]],
    surfaces: KDTree,
    plane: SupportPlane,
) -> Bool[np.ndarray, "h w"]:
    """Return the unexplained pixels that continue a mask.

    What is in the mask of something else is a piece of its own: a part may touch a thing that is none.
    """
    rows, columns = bounding_window(mask)
    reach = int(REACH * max(rows.stop - rows.start, columns.stop - columns.start)) + 1
    window = bounding_window(mask, reach)
    open_ = np.zeros_like(mask)
    if not (mask & (frame.depth > 0)).any():
        return open_
    open_[window] = frame.depth[window] > 0
    open_ &= ~mask & (height_image(frame, plane) > ABOVE)
    part = np.zeros_like(mask)
    if not open_.any():
        return part
    distance = surfaces.query(points_of(frame, open_), distance_upper_bound=2 * FAR)[0]
    open_[open_] = distance > FAR
    open_ &= ~beside_jumps(open_, frame.depth, JUMP)
    own, around = int(mask.sum()), _around(mask, frame)
    in_others = np.any([np.zeros_like(mask), *others], axis=0)
    for region in (~in_others, *others):
        count, labels = cv2.connectedComponents((open_ & region).astype(np.uint8))
        size = np.bincount(labels.ravel(), minlength=count)
        for label in np.unique(labels[around & (labels > 0)]):
            piece = labels == label
            fits = max(SMALLEST * own, MIN_PIXELS) <= size[label] <= LARGEST * own
            if fits and _continues(piece & around, mask, frame.depth):
                part |= piece
    return part


def _around(mask: Bool[np.ndarray, "h w"], frame: RgbdFrame) -> Bool[np.ndarray, "h w"]:
    """Return the pixels in which a part may begin: the object's own shape explains what is nearer to it."""
    depth = np.median(frame.depth[mask & (frame.depth > 0)])
    side = 2 * int(1.5 * FAR * frame.intrinsics.fx / depth) + 5
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def _continues(
    contact: Bool[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"]
) -> bool:
    """Return whether a piece is as far away, where it is nearest to a mask, as the mask's border there."""
    beside = mask & (cv2.dilate(contact.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0) & (depth > 0)
    if not beside.any() or not (contact & (depth > 0)).any():
        return False
    gap = abs(float(np.median(depth[contact & (depth > 0)]) - np.median(depth[beside])))
    return gap < 2 * JUMP
