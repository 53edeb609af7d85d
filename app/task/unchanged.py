"""What looks as in the round before was judged then: candidates of no class, and parts of such things.

The scans of two rounds are from the same viewpoints; images of what was left, from nearby, come after them.
Where nothing near a candidate has moved since, and nothing in front of it, its fits would be repeated on the
same measurements. So they would where a candidate was segmented then as it is now, whatever was taken away
beside it. A part of a thing remains one where an object was taken away beside it: that was not what it went
on in, and without it there is less to tell that by.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.depth_cleaning import clean_frame
from perception.detection.geometry import plan_coordinates, points_of
from perception.detection.left_out import LeftOut
from perception.detection.unclassified import is_open
from perception.inference.recutting import instance_ids
from perception.pipeline import Detections
from perception.types import ObjectEstimate, RejectedObject, RgbdFrame, SupportPlane

SAME_VIEW = 0.003  # [m] and [rad] between two poses of the camera
CHANGED = 0.015  # [m] between the depths of a pixel, from which on something has moved
NEAR = 0.03  # [m] in plan view from what has moved or was left, within which a candidate is judged again
FEW = 0.02  # share of a candidate's points that may be near it
AT = 0.01  # [m] in plan view from a part, or from what has moved, within which a part is the same, or is not
MOST = 0.8  # share of a part's points that are where one was before, at least
SAME_MASK = 0.7  # intersection over union of two masks of one candidate, at least
ALIKE = 0.9  # share of its pixels whose depth has not changed, at least
_CELL = 0.005  # [m] in which changed points are counted
_LEAST = 4  # changed points in a cell: fewer are noise
_POINTS = 500  # of a candidate


@dataclass(frozen=True)
class ScannedRound:
    """What a round saw.

    Attributes:
        frames: Images with camera poses, without the robot.
        detections: Detections in them.
        rejected: Detected objects that it did not report, by the ids of the detections.
        objects: Objects that it found.
    """

    frames: Sequence[RgbdFrame]
    detections: Detections
    rejected: Sequence[RejectedObject] = ()
    objects: Sequence[ObjectEstimate] = ()


def with_judged(
    detections: Detections,
    frames: Sequence[RgbdFrame],
    before: ScannedRound,
    left: Sequence[ObjectEstimate] = (),
    n_scanned: int | None = None,
) -> Detections:
    """Return the detections with the candidates marked that look as they did in images taken before.

    Args:
        detections: Detections in the images.
        frames: Images with camera poses, without the robot.
        before: The round before; without an image from each viewpoint of the scan nothing is marked.
        left: Objects that were found then and were not placed: they are fitted again.
        n_scanned: Number of the first images that are the scan, see ``_changed_places``; all if None.
    """
    changed = _changed_places(frames[:n_scanned], before.frames, detections.plane, with_hidden=True)
    if changed is None:
        return detections
    to_left, to_changed = _distance_to(_places(left, detections.plane)), _distance_to([changed])

    def was_judged(candidate: LeftOut) -> bool:
        frame = frames[candidate.frame]
        plan = _plan_points([(frame, candidate.mask)], detections.plane)
        near_left = to_left(plan) < NEAR
        if not len(plan) or near_left.mean() > FEW:
            return False
        is_unchanged = (near_left | (to_changed(plan) < NEAR)).mean() <= FEW
        return bool(is_unchanged) or _was_candidate(candidate, frame, before)

    return replace(
        detections,
        left_out=tuple(
            replace(candidate, was_judged=was_judged(candidate)) for candidate in detections.left_out
        ),
    )


def parts_as_before(
    detections: Detections,
    frames: Sequence[RgbdFrame],
    before: ScannedRound,
    n_scanned: int | None = None,
) -> list[RejectedObject]:
    """Return the detected objects that the round before saw, unchanged, as parts of things of no class.

    Args:
        detections: Detections in the images.
        frames: Images with camera poses, without the robot.
        before: The round before; without an image from each viewpoint of the scan nothing is known.
        n_scanned: Number of the first images that are the scan, see ``_changed_places``; all if None.
    """
    parts = [item for item in before.rejected if item.is_part]
    plane = detections.plane
    scanned = frames[:n_scanned]
    changed = _changed_places(scanned, before.frames, plane, with_hidden=False) if parts else None
    if changed is None:
        return []
    known = _distance_to(_places(before.objects, plane))(changed) < AT
    distance_to_changed = _distance_to([changed[~known]])
    places = [
        (part, _distance_to([_plan_points(_masks(before.detections, before.frames, part.id), plane)]))
        for part in parts
    ]
    found: list[RejectedObject] = []
    for id in sorted(instance_ids(detections.per_frame)):
        plan = _plan_points(_masks(detections, frames, id), plane)
        if not len(plan) or (distance_to_changed(plan) < AT).mean() > FEW:
            continue
        same = (part for part, distance_to in places if (distance_to(plan) < AT).mean() > MOST)
        found += [replace(part, id=id) for part in same][:1]
    return found


def _was_candidate(candidate: LeftOut, frame: RgbdFrame, before: ScannedRound) -> bool:
    """Return whether an image from the same viewpoint had a candidate with the same mask and depth."""
    old = _from_same_view(frame, before.frames)
    if old is None:
        return False
    measured = candidate.mask & (old.depth > 0) & (frame.depth > 0)
    is_same = np.abs(old.depth - frame.depth)[measured] < CHANGED
    if not measured.any() or is_same.mean() < ALIKE:
        return False
    masks = [c.mask for c in before.detections.left_out if before.frames[c.frame] is old and is_open(c)]
    return any((m & candidate.mask).sum() >= SAME_MASK * (m | candidate.mask).sum() for m in masks)


def without_instances(detections: Detections, ids: Iterable[int]) -> Detections:
    """Return the detections, those of some instances without an id, so that they only occlude others."""
    left = frozenset(ids)
    rows = (
        tuple(replace(d, instance_id=None) if d.instance_id in left else d for d in row)
        for row in detections.per_frame
    )
    return replace(detections, per_frame=tuple(rows)) if left else detections


def _places(objects: Iterable[ObjectEstimate], plane: SupportPlane) -> list[Float[np.ndarray, "_n 2"]]:
    """Return the plan coordinates [m] of the surfaces of objects."""
    return [plan_coordinates(estimate.mesh_world.vertices, plane) for estimate in objects]


def _masks(
    detections: Detections, frames: Sequence[RgbdFrame], id: int
) -> list[tuple[RgbdFrame, Bool[np.ndarray, "h w"]]]:
    """Return the masks of an instance with their images."""
    rows = zip(frames, detections.per_frame, strict=True)
    return [(frame, d.mask) for frame, row in rows for d in row if d.instance_id == id]


def _plan_points(
    masks: Iterable[tuple[RgbdFrame, Bool[np.ndarray, "h w"]]], plane: SupportPlane
) -> Float[np.ndarray, "n 2"]:
    """Return the plan coordinates [m] of some measured points of masks, as many of each mask at most."""
    plans = [np.zeros((0, 2))]
    for frame, mask in masks:
        points = points_of(frame, mask)
        plans.append(plan_coordinates(points[:: max(1, len(points) // _POINTS)], plane))
    return np.concatenate(plans)


def _distance_to(
    places: Sequence[Float[np.ndarray, "_n 2"]],
) -> Callable[[Float[np.ndarray, "m 2"]], Float[np.ndarray, "m"]]:
    """Return the function that gives the distance [m] of plan coordinates to the nearest of places."""
    known = np.concatenate([np.zeros((0, 2)), *places])
    if not len(known):
        return lambda plan: np.full(len(plan), np.inf)
    tree = KDTree(known)
    return lambda plan: tree.query(plan)[0]


def _changed_places(
    frames: Sequence[RgbdFrame], before: Sequence[RgbdFrame], plane: SupportPlane, with_hidden: bool
) -> Float[np.ndarray, "n 2"] | None:
    """Return the plan coordinates [m] of what has changed since images before; None if they do not tell.

    They do if each of the images has one from the same viewpoint among those before.
    """
    pairs = [(_from_same_view(frame, before), frame) for frame in frames]
    changed = [_changes(old, new, plane, with_hidden) for old, new in pairs if old is not None]
    if not frames or len(changed) < len(frames):
        return None
    cells, count = np.unique(
        np.floor(np.concatenate(changed) / _CELL).astype(np.int64), axis=0, return_counts=True
    )
    return (cells[count >= _LEAST] + 0.5) * _CELL


def _from_same_view(frame: RgbdFrame, others: Sequence[RgbdFrame]) -> RgbdFrame | None:
    """Return the image that was taken from where another one was; None without one."""
    assert frame.T_world_camera is not None
    same = (
        other
        for other in others
        if other.T_world_camera is not None
        and other.intrinsics == frame.intrinsics
        and np.abs(other.T_world_camera - frame.T_world_camera).max() < SAME_VIEW
    )
    return next(same, None)


def _changes(
    before: RgbdFrame, after: RgbdFrame, plane: SupportPlane, with_hidden: bool
) -> Float[np.ndarray, "n 2"]:
    """Return the plan coordinates [m] of what only one of two images from the same viewpoint shows.

    Args:
        before, after: The images.
        plane: Support plane.
        with_hidden: Whether what was taken away had hidden counts, and what is hidden now.
    """
    old, new = clean_frame(before), clean_frame(after)
    is_measured = (old.depth > 0) & (new.depth > 0)
    differs = is_measured & (np.abs(old.depth - new.depth) > CHANGED)
    opened = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    gone, come = old.depth < new.depth, old.depth > new.depth
    points = np.concatenate(
        [points_of(old, opened & (gone | with_hidden)), points_of(new, opened & (come | with_hidden))]
    )
    return plan_coordinates(points, plane)
