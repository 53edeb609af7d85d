"""Associates detections of one physical object across posed views and fuses their class votes.

Each detection leaves a footprint on the support plane: the convex hull of its points in the plan view.
Footprints of one object from different viewpoints overlap, footprints of different objects do not. Where a
view merges or splits objects, the object count of most views decides. Class log-probabilities are summed over
the views, with less weight for masks truncated by the image border and with a vote against the object from
every view that should contain it but has no detection; yaw distributions are multiplied. Objects whose most
probable class is 'other' are dropped, as are weak detections that a single view makes against the others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import connected_components

from perception.detection.geometry import plan_coordinates, points_of, project, touches_border
from perception.detection.left_out import LeftOut, Reason
from perception.detection.yaw import fuse_yaws
from perception.errors import InvalidInputError
from perception.support.surface import SupportSurface
from perception.types import CATEGORIES, OTHER, ObjectDetection, RgbdFrame, SupportPlane


@dataclass(frozen=True)
class AssociationConfig:
    """Parameters of the association of detections across views.

    Attributes:
        min_overlap: Smallest intersection of two footprints of one object, as a share of the smaller one.
        merged_share: Share of each of two objects' footprints from which on a detection covering both is
            taken for a merger of them and left out.
        cell: Side of the footprint grid's cells, in metres.
        max_extent: Largest extent of an object in the plan view, in metres.
        single_view_score: Smallest score of an object detected in one view only, although two or more other
            views should contain it.
        visible_share: Share of an object's points that must be inside the image and unoccluded for the view
            to be expected to contain a detection of it.
        miss_probability: Probability that such a view has no detection of an object of one of the classes.
            For 'other' it is the complement, since the detector suppresses that class.
        truncated_weight: Weight of the class vote of a mask that is truncated by the image border.
        independence: Exponent of the effective number of views, n^independence: views err alike.
    """

    min_overlap: float = 0.3
    merged_share: float = 0.5
    cell: float = 0.004
    max_extent: float = 0.36
    single_view_score: float = 0.8
    visible_share: float = 0.6
    miss_probability: float = 0.2
    truncated_weight: float = 0.5
    independence: float = 0.5


@dataclass(frozen=True, eq=False)
class _Footprint:
    """One detection in the plan view."""

    view: int
    detection: ObjectDetection
    points: Float[np.ndarray, "n 3"]  # sample of its point cloud in the world frame [m]
    hull: Float[np.ndarray, "m 2"]  # corners along the plane's axes [m]


def associate(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    plane: SupportPlane,
    config: AssociationConfig = AssociationConfig(),
) -> list[list[ObjectDetection]]:
    """Return the detections of each frame with instance ids and fused classes, as ``fuse_views`` does."""
    return fuse_views(frames, detections_per_frame, plane, config)[0]


def fuse_views(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    plane: SupportPlane,
    config: AssociationConfig = AssociationConfig(),
) -> tuple[list[list[ObjectDetection]], list[LeftOut]]:
    """Associate detections across views, fuse their classes, and reject objects that the views contradict.

    Args:
        frames: Views with poses; a single frame may lack its pose.
        detections_per_frame: Detections of each frame.
        plane: Support plane in the world frame.
        config: Parameters.

    Returns:
        For each frame its detections with ``instance_id`` (0, 1, ... by descending number of views, then
        score) and with the category, score, class and yaw probabilities fused over all views. An object
        appears at most once per frame. For a single frame only objects of class 'other' are dropped. Then
        the detections of rejected objects, with the reason.

    Raises:
        InvalidInputError: The numbers of frames and of detection lists differ, or one of several frames has
            no pose.
    """
    if len(frames) != len(detections_per_frame):
        raise InvalidInputError(f"{len(frames)} frames but detections for {len(detections_per_frame)}")
    if len(frames) > 1 and any(frame.T_world_camera is None for frame in frames):
        raise InvalidInputError("associating several views needs T_world_camera of every frame")
    footprints = [
        _footprint(view, detection, frames[view], plane)
        for view, detections in enumerate(detections_per_frame)
        for detection in detections
    ]
    footprints = [f for f in footprints if len(f.points)]
    objects = [group for cluster in _clusters(footprints, config) for group in _separate(cluster, config)]
    fused_groups, left_out = [], []
    for group in objects:
        fused = _fuse(group, frames, config)
        if isinstance(fused, list):
            fused_groups.append(fused)
        else:
            left_out += [LeftOut(f.detection.mask, *fused, frame=f.view) for f in group]
    fused_groups.sort(key=lambda group: (-len(group), -group[0].detection.score))
    result: list[list[ObjectDetection]] = [[] for _ in frames]
    for instance_id, group in enumerate(fused_groups):
        for f in group:
            result[f.view].append(replace(f.detection, instance_id=instance_id))
    return result, left_out


def associate_on_surfaces(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    surfaces: Sequence[SupportSurface],
    config: AssociationConfig = AssociationConfig(),
) -> tuple[tuple[tuple[ObjectDetection, ...], ...], tuple[LeftOut, ...]]:
    """Return the result of ``fuse_views`` for the detections of each surface, with ids unique over all."""
    rows: list[list[ObjectDetection]] = [[] for _ in frames]
    left_out: list[LeftOut] = []
    count = 0
    for support, surface in enumerate(surfaces):
        there = [[d for d in row if d.support == support] for row in detections_per_frame]
        fused, rejected = fuse_views(frames, there, surface.plane, config)
        for row, more in zip(rows, fused):
            row += [replace(d, instance_id=count + (d.instance_id or 0)) for d in more]
        count += len({d.instance_id for more in fused for d in more})
        left_out += rejected
    return tuple(map(tuple, rows)), tuple(left_out)


def _footprint(view: int, detection: ObjectDetection, frame: RgbdFrame, plane: SupportPlane) -> _Footprint:
    """Return the footprint of a detection, without mask-border pixels and points on the plane.

    Masks are slightly too large, so both are mostly background.
    """
    core = cv2.erode(detection.mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    points = points_of(frame, core if core.any() else detection.mask)
    raised = points[plane.height_above(points) > 0.005]
    points = (raised if len(raised) >= 10 else points)[:: max(1, len(points) // 2000)]
    plan = plan_coordinates(points, plane)
    if len(plan) > 20:  # outliers at depth discontinuities must not stretch the hull
        low, high = np.percentile(plan, (1, 99), axis=0)
        plan = plan[((plan >= low) & (plan <= high)).all(1)]
    hull = cv2.convexHull(plan.astype(np.float32))[:, 0] if len(plan) else np.zeros((0, 2), np.float32)
    return _Footprint(view, detection, points, hull)


def _rasterised(hulls: Sequence[np.ndarray], cell: float) -> list[np.ndarray]:
    """Return footprints as bool images on one common plan-view grid."""
    corners = np.concatenate(hulls)
    low = corners.min(0) - 2 * cell
    size = np.ceil((corners.max(0) - low) / cell).astype(int) + 3
    images = []
    for hull in hulls:
        image = np.zeros(size[::-1], np.uint8)
        cv2.fillConvexPoly(image, np.rint((hull - low) / cell).astype(np.int32), 1)
        images.append(image.astype(bool))
    return images


def _clusters(footprints: list[_Footprint], config: AssociationConfig) -> list[list[_Footprint]]:
    """Return the connected components of footprints that overlap across views."""
    if not footprints:
        return []
    linked = np.zeros((len(footprints), len(footprints)), bool)
    for i, a in enumerate(footprints):
        for j, b in enumerate(footprints[:i]):
            apart = (a.hull.min(0) > b.hull.max(0)).any() or (b.hull.min(0) > a.hull.max(0)).any()
            if a.view != b.view and not apart:
                first, second = _rasterised((a.hull, b.hull), config.cell)
                shared = (first & second).sum()
                linked[i, j] = shared >= config.min_overlap * min(first.sum(), second.sum())
    labels = connected_components(linked, directed=False)[1]
    return [[f for f, k in zip(footprints, labels) if k == label] for label in range(labels.max() + 1)]


def _separate(cluster: list[_Footprint], config: AssociationConfig) -> list[list[_Footprint]]:
    """Return one group per physical object, each with at most one detection per view.

    The number of objects is the mode of the views' detection counts, the larger one in a tie: two detections
    in one view are rarely one object. Among the views with that count, the one with the largest footprints
    provides the anchors to which the other detections are assigned.
    """
    count_of_view = Counter(f.view for f in cluster)
    if max(count_of_view.values()) == 1:
        return [cluster]
    votes = Counter(count_of_view.values())
    n_objects = max(votes, key=lambda n: (votes[n], n))
    images = dict(zip(cluster, _rasterised([f.hull for f in cluster], config.cell)))
    views = [view for view, n in count_of_view.items() if n == n_objects]
    area = {v: sum(images[f].sum() for f in cluster if f.view == v) for v in views}
    anchors = [f for f in cluster if f.view == max(views, key=lambda v: area[v])]

    groups: list[list[_Footprint]] = [[anchor] for anchor in anchors]
    for f in cluster:
        if f in anchors:
            continue
        shared = np.array([(images[f] & images[anchor]).sum() for anchor in anchors])
        covered = shared / np.array([max(images[anchor].sum(), 1) for anchor in anchors])
        if (covered > config.merged_share).sum() <= 1 and shared.max() > 0:  # otherwise it merges several
            groups[int(shared.argmax())].append(f)
    return [_one_per_view(group) for group in groups]


def _one_per_view(group: list[_Footprint]) -> list[_Footprint]:
    """Unite the parts of one object in each view: one mask, the class and yaw of the largest part."""
    united = []
    for view in sorted({f.view for f in group}):
        parts = sorted((f for f in group if f.view == view), key=lambda f: -int(f.detection.mask.sum()))
        largest = parts[0]
        if len(parts) > 1:
            mask = np.logical_or.reduce([f.detection.mask for f in parts])
            points = np.concatenate([f.points for f in parts])
            largest = replace(largest, detection=replace(largest.detection, mask=mask), points=points)
        united.append(largest)
    return united


def _fuse(
    group: list[_Footprint], frames: Sequence[RgbdFrame], config: AssociationConfig
) -> list[_Footprint] | tuple[Reason, str]:
    """Return the group with its fused class, score and yaw, or why it is rejected."""
    extent = float(np.ptp(np.concatenate([f.hull for f in group]), axis=0).max())
    if extent > config.max_extent:
        return "too wide for one object", f"{100 * extent:.0f} cm"
    n_missed = _count_missed_views(group, frames, config)
    best_score = max(f.detection.score for f in group)
    if len(group) == 1 and n_missed >= 2 and best_score < config.single_view_score:
        return "seen in one view only", f"{n_missed} others should show it"

    log = np.sum([_weight(f.detection, config) * _log_probabilities(f.detection) for f in group], axis=0)
    log = log + n_missed * np.log([config.miss_probability] * OTHER + [1 - config.miss_probability])
    n_views = len(group) + n_missed
    weight = np.exp((log - log.max()) * n_views ** (config.independence - 1))
    probabilities = weight / weight.sum()
    if int(log.argmax()) == OTHER:
        return "of none of the classes", f"p = {probabilities[OTHER]:.2f}"
    category = CATEGORIES[int(probabilities[:OTHER].argmax())]
    yaws = [f.detection.yaw_probabilities for f in group if len(f.detection.yaw_probabilities)]
    changes = {
        "category": category,
        "score": float(probabilities[:OTHER].max()),
        "class_probabilities": probabilities,
        "yaw_probabilities": fuse_yaws(yaws) if yaws and category == "mug" else np.zeros(0),
    }
    return [replace(f, detection=replace(f.detection, **changes)) for f in group]


def _weight(detection: ObjectDetection, config: AssociationConfig) -> float:
    return config.truncated_weight if touches_border(detection.mask) else 1.0


def _log_probabilities(detection: ObjectDetection) -> Float[np.ndarray, "5"]:
    """Return log-probabilities of the five classes, each probability at least 0.005.

    A detection without class probabilities gets its score for its category and equal shares for the others.
    """
    p = np.asarray(detection.class_probabilities, dtype=np.float64)
    if len(p) != OTHER + 1:
        p = np.full(OTHER + 1, (1 - detection.score) / OTHER)
        p[CATEGORIES.index(detection.category)] = detection.score
    return np.log(np.clip(p, 0.005, 1.0))


def _count_missed_views(
    group: list[_Footprint], frames: Sequence[RgbdFrame], config: AssociationConfig
) -> int:
    """Return the number of views with the object inside the image and unoccluded, but without a detection."""
    points = np.concatenate([f.points for f in group])[:: max(1, len(group))]
    missed = 0
    for view in set(range(len(frames))) - {f.view for f in group}:
        frame = frames[view]
        pixels, z = project(frame, points)
        size = (frame.intrinsics.width, frame.intrinsics.height)
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
        u, v = pixels[inside].T
        measured = frame.depth[v, u]
        unoccluded = (measured == 0) | (measured > z[inside] - 0.03)
        missed += unoccluded.sum() >= config.visible_share * len(points)
    return int(missed)
