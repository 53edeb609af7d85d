"""Votes and counts of landmarks by frame, and the limits beyond which they are retired."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from perception.slam.association import RenderedMasks
from perception.slam.config import LandmarkLifecycleConfig
from perception.slam.labelled_frame import LabelledFrame
from perception.slam.landmarks import Landmark

_OPEN_RATIO = 0.6  # unoccluded share of a landmark above which a missing mask counts as a miss


def with_detections(
    landmarks: Mapping[int, Landmark],
    view: LabelledFrame,
    inlier_ratios: Mapping[int, float],
    inlier_ratio_min: float,
) -> dict[int, Landmark]:
    """Return the landmarks with votes, hits and outlier frames of the masks that are associated with them.

    Args:
        landmarks: Landmarks of the map.
        view: The newest frame with its association.
        inlier_ratios: Inlier ratio of each landmark that tracking judged.
        inlier_ratio_min: Share of the best inlier ratio below which the frame is an outlier of a landmark.
    """
    updated, best = dict(landmarks), max(inlier_ratios.values(), default=0.0)
    for label, id in view.landmark_of.items():
        if id not in landmarks:
            continue
        landmark = landmarks[id].with_detection(view.detections[label - 1])
        if id in inlier_ratios:
            outlier = inlier_ratios[id] < inlier_ratio_min * best
            landmark = replace(landmark, n_outlier_frames=landmark.n_outlier_frames + 1 if outlier else 0)
        updated[id] = landmark
    return updated


def with_visibility(
    landmarks: Mapping[int, Landmark],
    rendered: RenderedMasks,
    see_through: Mapping[int, float],
    detected: Collection[int],
    config: LandmarkLifecycleConfig,
) -> dict[int, Landmark]:
    """Return the landmarks with the misses and absences of a visibility check.

    Args:
        landmarks: Landmarks of the map.
        rendered: Rendered masks of the map in the newest frame.
        see_through: Share of each landmark's visible pixels that measure the background.
        detected: Ids of the landmarks with a mask.
        config: Limits.
    """
    updated = {}
    for id, landmark in landmarks.items():
        visible = rendered.n_visible.get(id, 0)
        if id not in detected and visible * rendered.pitch**2 > 2 * config.min_pixels:
            open_ratio = visible / max(rendered.n_unoccluded[id], 1)
            landmark = replace(landmark, n_misses=landmark.n_misses + (open_ratio > _OPEN_RATIO))
        if id in see_through:
            absent = see_through[id] > config.see_through_ratio
            landmark = replace(landmark, n_see_through=landmark.n_see_through + 1 if absent else 0)
        updated[id] = landmark
    return updated


def has_failed(landmark: Landmark, config: LandmarkLifecycleConfig) -> bool:
    """Return whether a landmark has exceeded a limit."""
    return (
        landmark.n_misses > min(config.max_misses, landmark.n_hits)
        or landmark.n_outlier_frames > config.max_outlier_frames
        or landmark.n_see_through > config.max_see_through
    )
