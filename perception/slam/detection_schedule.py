"""When a frame needs detections; between such frames masks are rendered from the map (``mask_tracking``).

Detections are due at intervals and while the map waits for them. A frame between is doubtful if it looks less
like the map than the first frame after the last detection: more depth that no landmark explains, landmarks
that are no longer measured where they should be, or fewer inliers of tracking.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from perception.slam.mask_tracking import TrackedMasks


@dataclass(frozen=True)
class DetectionScheduleConfig:
    """When detections are needed.

    Attributes:
        max_interval: Frames from one detection to the next, at most; 1 detects in every frame.
        max_interval_waiting: The same while a landmark's absence is being verified.
        min_interval: Frames after a detection in which a new viewpoint does not require another.
        new_pixels: Increase of the number of unexplained image pixels that makes a frame doubtful.
        min_explained: Share of a landmark's measured pixels that belong to it, relative to the reference,
            below which a frame is doubtful.
        min_inlier_ratio: The same of the median inlier ratio of tracking.
        outlier_ratio: Inlier ratio of a landmark relative to the best one below which it is an outlier.
    """

    max_interval: int = 10
    max_interval_waiting: int = 4
    min_interval: int = 3
    new_pixels: int = 600
    min_explained: float = 0.6
    min_inlier_ratio: float = 0.85
    outlier_ratio: float = 0.5


@dataclass(frozen=True)
class _Reference:
    """What the first frame after a detection looked like."""

    masks: TrackedMasks
    inlier_ratio: float
    outliers: frozenset[int]


class DetectionSchedule:
    """Frames since the last detection, and the frame that doubts are relative to."""

    def __init__(self, config: DetectionScheduleConfig = DetectionScheduleConfig()) -> None:
        self.config = config
        self._last = 0  # number of the last frame with detections
        self._reference: _Reference | None = None

    def detected(self, number: int) -> None:
        """Note that a frame has detections."""
        self._last, self._reference = number, None

    def is_due(self, number: int, urgent: bool, waiting: bool) -> bool:
        """Return whether a frame needs detections whatever it shows.

        Args:
            number: Number of the frame.
            urgent: Whether the map needs them in successive frames.
            waiting: Whether a landmark's absence is being verified.
        """
        interval = self.config.max_interval_waiting if waiting else self.config.max_interval
        return urgent or number - self._last >= min(interval, self.config.max_interval)

    def allows_keyframe(self, number: int) -> bool:
        """Return whether a new viewpoint requires a detection."""
        return number - self._last >= self.config.min_interval

    def is_doubtful(
        self, masks: TrackedMasks, median_inlier_ratio: float, inlier_ratios: Mapping[int, float]
    ) -> bool:
        """Return whether a tracked frame looks less like the map than the reference, which it may become.

        Args:
            masks: Masks of the frame.
            median_inlier_ratio: Median inlier ratio of the landmarks that tracking used.
            inlier_ratios: Inlier ratio of every landmark that tracking judged.
        """
        config = self.config
        best = max(inlier_ratios.values(), default=0.0)
        outliers = frozenset(id for id, ratio in inlier_ratios.items() if ratio < config.outlier_ratio * best)
        if self._reference is None:
            self._reference = _Reference(masks, median_inlier_ratio, outliers)
            return False
        before = self._reference
        return (
            masks.n_unexplained > before.masks.n_unexplained + config.new_pixels
            or median_inlier_ratio < config.min_inlier_ratio * before.inlier_ratio
            or not outliers <= before.outliers
            or any(
                share < config.min_explained * before.masks.explained.get(id, 1.0)
                for id, share in masks.explained.items()
            )
        )
