"""Masks without a landmark: how long each has been visible, and when a landmark is initialised from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from perception.detection.geometry import touches_border
from perception.slam.config import LandmarkLifecycleConfig
from perception.slam.labelled_frame import LabelledFrame

_SAME_MASK_IOU = 0.2  # IoU with a mask of the previous frame above which they are the same


@dataclass(frozen=True)
class UnmatchedMask:
    """A mask without a landmark.

    Attributes:
        mask: Pixels of the mask in the newest frame with detections.
        n_frames: Number of successive frames with detections in which it has been unmatched.
        tried: Number of the frame of the last attempt to initialise it; None before the first.
    """

    mask: Bool[np.ndarray, "h w"]
    n_frames: int
    tried: int | None = None

    def is_due(
        self, mask: Bool[np.ndarray, "h w"], number: int, supported: bool, config: LandmarkLifecycleConfig
    ) -> bool:
        """Return whether a landmark should be initialised.

        Args:
            mask: The mask in the newest frame.
            number: Number of the frame.
            supported: Whether enough landmarks constrain the camera; a truncated mask then waits until the
                object is fully visible.
            config: Sizes and intervals.
        """
        if self.n_frames < config.min_frames_unmatched:
            return False
        truncated = touches_border(mask)
        min_pixels = config.min_pixels_truncated if truncated else config.min_pixels
        too_small = np.count_nonzero(mask) < min_pixels
        waits = self.tried is not None and number - self.tried < config.retry_interval
        return not (waits or too_small or (truncated and supported))


def updated_masks(before: Mapping[int, UnmatchedMask], view: LabelledFrame) -> dict[int, UnmatchedMask]:
    """Return the masks without a landmark in a frame, by label.

    Args:
        before: Those of the previous frame with detections.
        view: The frame with its association.
    """
    unmatched = {}
    present = np.bincount(view.labels.ravel(), minlength=256) > 0
    for label, found in enumerate(view.detections, start=1):
        if label in view.landmark_of or not present[label]:  # not present: merged into another label
            continue
        same = [
            mask
            for mask in before.values()
            if (mask.mask & found.mask).sum() > _SAME_MASK_IOU * (mask.mask | found.mask).sum()
        ]
        n_frames = 1 + max((mask.n_frames for mask in same), default=0)
        tried = max((mask.tried for mask in same if mask.tried is not None), default=None)
        unmatched[label] = UnmatchedMask(found.mask, n_frames, tried)
    return unmatched
