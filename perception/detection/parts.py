"""Parts of things of no class that were segmented as instances of their own, such as one side of a carton.

The measured surface goes on beyond the outline of a part; it ends at the outline of an object, but for the
few pixels where it touches something.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.detection.geometry import bounding_window
from perception.detection.left_out import LeftOut
from perception.types import Category, ObjectDetection, RgbdFrame

SHARE = 0.16  # part of its outline along which the surface of a part goes on
CERTAIN = 0.9  # probability of a class from which on an instance is no part
OPEN: tuple[Category, ...] = ("mug", "bowl")
VIEWS = 3  # fewest that contradict a class that is certain
_WINDOW = 7  # side of the window in which the depth of both sides of an outline is averaged, in pixels
_MIN_PIXELS = 3  # measured ones in it
_GAP = (0.006, 0.004)  # depth difference of one surface: constant in metres, and per squared metre of depth


def parts_of_things(
    frames: Sequence[RgbdFrame],
    rows: Sequence[Sequence[ObjectDetection]],
    left_out: Sequence[LeftOut],
) -> set[int]:
    """Return the ids of mugs and bowls whose surface goes on in things of no class in most of their views.

    The shaft of a boot is a mug by its shape, each view's network is sure of it, and a mug fits. Bottles and
    cans are closed: what the networks are sure of is whole, and touches the thing.

    Args:
        frames: Images.
        rows: Associated detections of each frame.
        left_out: What has no class in them.
    """
    nameless = [item for item in left_out if item.reason == "of none of the classes"]
    things = [[item.mask for item in nameless if item.frame == k] for k in range(len(frames))]
    shares = continued_shares(frames, rows, things)
    open_ = {d.instance_id for row in rows for d in row if d.category in OPEN}
    return {
        id for id, seen in shares.items() if id in open_ and len(seen) >= VIEWS and np.median(seen) > SHARE
    }


def continued_shares(
    frames: Sequence[RgbdFrame],
    rows: Sequence[Sequence[ObjectDetection]],
    things: Sequence[Sequence[Bool[np.ndarray, "H W"]]],
) -> dict[int, list[float]]:
    """Return the ``continued_share`` of each instance in each of its views, by id.

    Args:
        frames: Images.
        rows: Associated detections of each frame.
        things: Masks of things of no class in each frame.
    """
    shares: dict[int, list[float]] = {}
    for frame, row, masks in zip(frames, rows, things, strict=True):
        others = np.any(masks, axis=0) if masks else np.zeros(frame.depth.shape, bool)
        for d in row:
            if d.instance_id is not None:
                share = continued_share(d.mask, others & ~d.mask, frame.depth)
                shares.setdefault(d.instance_id, []).append(share)
    return shares


def continued_share(
    mask: Bool[np.ndarray, "H W"], other: Bool[np.ndarray, "H W"], depth: Float[np.ndarray, "H W"]
) -> float:
    """Return the share of a mask's outline across which the measured surface goes on in another mask.

    Args:
        mask: Pixels of an instance, at least one.
        other: Pixels of another one.
        depth: Depth in metres, 0 where it is missing.
    """
    window = bounding_window(mask, _WINDOW)
    mask, other, depth = mask[window], other[window], depth[window]
    if not other.any():
        return 0.0
    outline = mask & (cv2.erode(mask.view(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) == 0)
    here, there = _mean_depth(mask, depth), _mean_depth(other, depth)
    goes_on = np.abs(here - there) < _GAP[0] + _GAP[1] * here**2  # False where either is unknown
    return float((outline & goes_on).sum() / outline.sum())


def _mean_depth(mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the mean depth of a mask's pixels around every pixel; NaN where there are too few."""
    weight = (mask & (depth > 0)).astype(np.float32)
    size = (_WINDOW, _WINDOW)
    count = cv2.boxFilter(weight, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    total = cv2.boxFilter(weight * depth, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.where(count >= _MIN_PIXELS, total / np.maximum(count, 1.0), np.nan)
