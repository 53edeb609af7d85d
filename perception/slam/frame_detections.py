"""Detections of one frame, merged into one mask for each object."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from perception.errors import PerceptionError
from perception.slam.mask_merging import MaskMergingConfig, merge_masks
from perception.support_plane import fit_support_plane
from perception.types import ObjectDetection, RgbdFrame, SupportPlane

Detect = Callable[[RgbdFrame, SupportPlane], Sequence[ObjectDetection]]


def detect_posed(
    detect: Detect, frame: RgbdFrame, plane: SupportPlane, config: MaskMergingConfig
) -> list[ObjectDetection]:
    """Return the detections of a frame of known pose, given the support plane in the world frame."""
    return merge_masks(frame, detect(frame, plane), plane, config)


def detect_unposed(detect: Detect, frame: RgbdFrame, config: MaskMergingConfig) -> list[ObjectDetection]:
    """Return the detections of a frame of unknown pose, with the support plane fitted to the frame.

    Without a plane, or where the detector fails, there are none.
    """
    unposed = RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics)
    try:
        return detect_posed(detect, unposed, fit_support_plane([unposed]), config)
    except PerceptionError:
        return []
