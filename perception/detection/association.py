"""Ties detections of one physical object across posed views and lets the views vote on what it is.

Each detection lays its footprint (the convex hull of its points in the plan view) on the support plane.
Footprints of one object seen from different sides overlap, those of different objects do not. Where one view
merges what others separate, or breaks apart what others hold together, the count that most views agree on
wins. Log-probabilities of the classes are summed over the views, yaw distributions multiplied; what then is
most probably of no class is dropped, and so is what one view alone claims to see against the others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components

from perception.detection.geometry import plan_coordinates, points_of, project
from perception.detection.yaw import fused
from perception.errors import InvalidInputError
from perception.types import CATEGORIES, ObjectDetection, RgbdFrame, SupportPlane

_OTHER = len(CATEGORIES)


@dataclass(frozen=True)
class AssociationConfig:
    """When detections are one object.

    Attributes:
        overlap: share of the smaller footprint that two views of one object have in common at least.
        merged: a detection that covers this share of two objects' footprints each is a merger of both.
        cell: resolution of the footprints in [m].
        max_extent: an object longer than this in the plan view in [m] is none of ours.
        lone_score: what only one view saw although at least two others should have must score this high.
        visible: share of an object's points that must be in view and unhidden for a view to be expected
            to see it.
        missed: probability that a view which should see an object of a class has no detection of it; the
            same for 'other' is its complement, since the detector leaves those out.
        cut: weight of the vote of a view in which the image border cuts the object.
        independence: views err alike; their summed log-probabilities count as n^independence views.
    """

    overlap: float = 0.3
    merged: float = 0.5
    cell: float = 0.004
    max_extent: float = 0.36
    lone_score: float = 0.8
    visible: float = 0.6
    missed: float = 0.2
    cut: float = 0.5
    independence: float = 0.5


@dataclass(frozen=True)
class _Seen:
    """One detection in the plan view."""

    view: int
    index: int
    detection: ObjectDetection
    points: Float[np.ndarray, "n 3"]  # a sample of its cloud in the world [m]
    hull: Float[np.ndarray, "m 2"]  # corners of its footprint along the plane's axes [m]


def associate(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    plane: SupportPlane,
    config: AssociationConfig = AssociationConfig(),
) -> list[list[ObjectDetection]]:
    """The detections per frame, tied and voted.

    Every detection returned has its ``instance_id`` (0, 1, ... by descending number of views and score), and
    the category, score, class and yaw probabilities of all views together. Each object appears at most once
    per frame. Works on a single frame too, where it only drops what is of no class.

    Raises:
        InvalidInputError: numbers of frames and detection lists differ, or several frames lack poses.
    """
    if len(frames) != len(detections_per_frame):
        raise InvalidInputError(f"{len(frames)} frames but detections for {len(detections_per_frame)}")
    if len(frames) > 1 and any(frame.T_world_camera is None for frame in frames):
        raise InvalidInputError("associating several views needs T_world_camera of every frame")
    seen = [
        _footprint(view, index, detection, frames[view], plane)
        for view, detections in enumerate(detections_per_frame)
        for index, detection in enumerate(detections)
    ]
    seen = [s for s in seen if len(s.points)]
    objects = [group for cluster in _clusters(seen, config) for group in _separated(cluster, config)]
    voted = [vote for group in objects if (vote := _voted(group, frames, config)) is not None]
    voted.sort(key=lambda vote: (-len(vote), -vote[0].detection.score))
    result: list[list[ObjectDetection]] = [[] for _ in frames]
    for number, group in enumerate(voted):
        for s in group:
            result[s.view].append(replace(s.detection, instance_id=number))
    return result


def _footprint(
    view: int, index: int, detection: ObjectDetection, frame: RgbdFrame, plane: SupportPlane
) -> _Seen:
    """Where a detection stands, without edge pixels and points on the plane: masks are a bit too wide."""
    core = cv2.erode(detection.mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    points = points_of(frame, core if core.any() else detection.mask)
    raised = points[plane.height_above(points) > 0.005]
    points = (raised if len(raised) >= 10 else points)[:: max(1, len(points) // 2000)]
    plan = plan_coordinates(points, plane)
    if len(plan) > 20:  # stray points at depth edges must not stretch the hull
        low, high = np.percentile(plan, (1, 99), axis=0)
        plan = plan[((plan >= low) & (plan <= high)).all(1)]
    hull = cv2.convexHull(plan.astype(np.float32))[:, 0] if len(plan) else np.zeros((0, 2), np.float32)
    return _Seen(view, index, detection, points, hull)


def _filled(hulls: Sequence[np.ndarray], cell: float) -> list[np.ndarray]:
    """Footprints as bool images on one common plan-view grid."""
    corners = np.concatenate(hulls)
    low = corners.min(0) - 2 * cell
    size = np.ceil((corners.max(0) - low) / cell).astype(int) + 3
    images = []
    for hull in hulls:
        image = np.zeros(size[::-1], np.uint8)
        cv2.fillConvexPoly(image, np.rint((hull - low) / cell).astype(np.int32), 1)
        images.append(image.astype(bool))
    return images


def _clusters(seen: list[_Seen], config: AssociationConfig) -> list[list[_Seen]]:
    """Detections whose footprints overlap, across views, directly or by way of others."""
    if not seen:
        return []
    linked = np.zeros((len(seen), len(seen)), bool)
    for i, a in enumerate(seen):
        for j, b in enumerate(seen[:i]):
            apart = (a.hull.min(0) > b.hull.max(0)).any() or (b.hull.min(0) > a.hull.max(0)).any()
            if a.view != b.view and not apart:
                first, second = _filled((a.hull, b.hull), config.cell)
                shared = (first & second).sum()
                linked[i, j] = shared >= config.overlap * min(first.sum(), second.sum())
    labels = connected_components(linked, directed=False)[1]
    return [[s for s, k in zip(seen, labels) if k == number] for number in range(labels.max() + 1)]


def _separated(cluster: list[_Seen], config: AssociationConfig) -> list[list[_Seen]]:
    """One group per physical object, each with at most one detection a view.

    The number of objects is what most views count, the larger one in a tie: two detections in one view
    rarely are one object. The view that shows that number in the largest footprints gives the anchors.
    """
    per_view = Counter(s.view for s in cluster)
    if max(per_view.values()) == 1:
        return [cluster]
    votes = Counter(per_view.values())
    number = max(votes, key=lambda n: (votes[n], n))
    images = dict(zip(map(id, cluster), _filled([s.hull for s in cluster], config.cell)))
    views = [view for view, n in per_view.items() if n == number]
    area = {v: sum(images[id(s)].sum() for s in cluster if s.view == v) for v in views}
    anchors = [s for s in cluster if s.view == max(views, key=lambda v: area[v])]

    groups: list[list[_Seen]] = [[anchor] for anchor in anchors]
    for s in cluster:
        if s in anchors:
            continue
        shared = np.array([(images[id(s)] & images[id(a)]).sum() for a in anchors])
        of_anchor = shared / np.array([max(images[id(a)].sum(), 1) for a in anchors])
        if (of_anchor > config.merged).sum() <= 1 and shared.max() > 0:  # else it merges several: not used
            groups[int(shared.argmax())].append(s)
    return [_one_per_view(group) for group in groups]


def _one_per_view(group: list[_Seen]) -> list[_Seen]:
    """Parts of one object in one view united: one mask, the class and yaw of the largest part."""
    united = []
    for view in sorted({s.view for s in group}):
        parts = sorted((s for s in group if s.view == view), key=lambda s: -int(s.detection.mask.sum()))
        main = parts[0]
        if len(parts) > 1:
            mask = np.logical_or.reduce([s.detection.mask for s in parts])
            points = np.concatenate([s.points for s in parts])
            main = replace(main, detection=replace(main.detection, mask=mask), points=points)
        united.append(main)
    return united


def _voted(group: list[_Seen], frames: Sequence[RgbdFrame], config: AssociationConfig) -> list[_Seen] | None:
    """The group with the views' common class, score and yaw, or None if it is no object of ours."""
    plan = np.concatenate([s.hull for s in group])
    if np.ptp(plan, axis=0).max() > config.max_extent:
        return None
    missing = _views_that_missed(group, frames, config)
    best_score = max(s.detection.score for s in group)
    if len(group) == 1 and missing >= 2 and best_score < config.lone_score:
        return None

    log = np.sum([_weight(s.detection, config) * _log_probabilities(s.detection) for s in group], axis=0)
    log = log + missing * np.log([config.missed] * _OTHER + [1 - config.missed])
    views = len(group) + missing
    if int(log.argmax()) == _OTHER:
        return None
    weight = np.exp((log - log.max()) * views ** (config.independence - 1))
    probabilities = weight / weight.sum()
    category = CATEGORIES[int(probabilities[:_OTHER].argmax())]
    yaws = [s.detection.yaw_probabilities for s in group if len(s.detection.yaw_probabilities)]
    changes = {
        "category": category,
        "score": float(probabilities[:_OTHER].max()),
        "class_probabilities": probabilities,
        "yaw_probabilities": fused(yaws) if yaws and category == "mug" else np.zeros(0),
    }
    return [replace(s, detection=replace(s.detection, **changes)) for s in group]


def _weight(detection: ObjectDetection, config: AssociationConfig) -> float:
    mask = detection.mask
    cut = mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
    return config.cut if cut else 1.0


def _log_probabilities(detection: ObjectDetection) -> Float[np.ndarray, "5"]:
    """Of the five classes, bounded from below; from category and score where a detection has no more."""
    p = np.asarray(detection.class_probabilities, dtype=np.float64)
    if len(p) != _OTHER + 1:
        p = np.full(_OTHER + 1, (1 - detection.score) / _OTHER)
        p[CATEGORIES.index(detection.category)] = detection.score
    return np.log(np.clip(p, 0.005, 1.0))


def _views_that_missed(group: list[_Seen], frames: Sequence[RgbdFrame], config: AssociationConfig) -> int:
    """How many views have the object's points in the image, unhidden, and yet no detection of it."""
    points = np.concatenate([s.points for s in group])[:: max(1, len(group))]
    missed = 0
    for view in set(range(len(frames))) - {s.view for s in group}:
        frame = frames[view]
        pixels, z = project(frame, points)
        size = (frame.intrinsics.width, frame.intrinsics.height)
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
        u, v = pixels[inside].T
        measured = frame.depth[v, u]
        unhidden = (measured == 0) | (measured > z[inside] - 0.03)
        missed += unhidden.sum() >= config.visible * len(points)
    return int(missed)
