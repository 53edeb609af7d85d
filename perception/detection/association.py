"""Associates detections of one physical object across posed views and fuses their class votes.

Detections are grouped by their footprints (``footprints``). Class log-probabilities are summed over
the views, with less weight for masks truncated by the image border and with a vote against the object from
every view that should contain it but has no detection; yaw distributions are multiplied. Objects whose most
probable class is 'other' are dropped, as are weak detections that a single view makes against the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from perception.detection.footprints import Footprint, GroupingConfig, clusters, separate
from perception.detection.geometry import in_image, project, touches_border
from perception.detection.left_out import LeftOut, Reason
from perception.detection.yaw import fuse_yaws
from perception.errors import InvalidInputError
from perception.support.surface import SupportSurface
from perception.types import CATEGORIES, OTHER, ObjectDetection, RgbdFrame, SupportPlane


@dataclass(frozen=True)
class AssociationConfig:
    """Parameters of the association of detections across views.

    Attributes:
        grouping: Parameters of the grouping of detections.
        max_extent: Largest extent of an object in the plan view, in metres.
        single_view_score: Smallest score of an object detected in one view only, although two or more other
            views should contain it.
        visible_share: Share of an object's points that must be inside the image and unoccluded for the view
            to be expected to contain a detection of it.
        miss_probability: Probability that such a view has no detection of an object of one of the classes.
            For 'other' it is the complement, since the detector suppresses that class.
        truncated_weight: Weight of the class vote of a mask that is truncated by the image border.
        max_other: Largest probability of 'other' of an object detected in a single view: up to it, the
            evidence of the fit decides. Several views reject what is most probably 'other'.
        independence: Exponent of the effective number of views, n^independence: views err alike.
    """

    grouping: GroupingConfig = field(default_factory=GroupingConfig)
    max_extent: float = 0.36
    single_view_score: float = 0.8
    visible_share: float = 0.6
    miss_probability: float = 0.2
    truncated_weight: float = 0.5
    max_other: float = 0.9
    independence: float = 0.5


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
        Footprint.of(view, detection, frames[view], plane)
        for view, detections in enumerate(detections_per_frame)
        for detection in detections
    ]
    footprints = [f for f in footprints if len(f.points)]
    objects = [
        group
        for cluster in clusters(footprints, config.grouping)
        for group in separate(cluster, config.grouping)
    ]
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


def _fuse(
    group: list[Footprint], frames: Sequence[RgbdFrame], config: AssociationConfig
) -> list[Footprint] | tuple[Reason, str]:
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
    is_other = probabilities[OTHER] > config.max_other if n_views == 1 else log.argmax() == OTHER
    if is_other:
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
    group: list[Footprint], frames: Sequence[RgbdFrame], config: AssociationConfig
) -> int:
    """Return the number of views with the object inside the image and unoccluded, but without a detection."""
    points = np.concatenate([f.points for f in group])[:: max(1, len(group))]
    missed = 0
    for view in set(range(len(frames))) - {f.view for f in group}:
        frame = frames[view]
        pixels, z = project(frame, points)
        inside = in_image(frame, pixels, z)
        u, v = pixels[inside].T
        measured = frame.depth[v, u]
        unoccluded = (measured == 0) | (measured > z[inside] - 0.03)
        missed += unoccluded.sum() >= config.visible_share * len(points)
    return int(missed)
