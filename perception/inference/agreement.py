"""Masks of one instance that other views contradict: what was segmented with its neighbour in some views.

A pixel of a mask is a point in space. Each other view of the instance in which that point is in plain sight
votes whether it belongs to the instance. Pixels that most of these views exclude are left out.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.detection.geometry import in_image, points_of, project
from perception.types import ObjectDetection, RgbdFrame, unclassified

Rows = Sequence[Sequence[ObjectDetection]]
Mask = Bool[np.ndarray, "h w"]

VIEWS = 3  # least number of views of an instance
VOTES = 2  # least number of views that exclude a pixel
SAME_SURFACE = 0.008  # [m] between a point and the depth that another view measures there
TRIMMED = 0.1  # least share of a mask that the other views exclude: less is noise at its border
LEFT = 0.1  # share of a mask that is left, below which the view does not show the instance
_BORDER = np.ones((5, 5), np.uint8)  # [px] of the filter that widens the voting masks, and smooths the result


def agreed_masks(views: Sequence[RgbdFrame], rows: Rows, ids: Collection[int]) -> list[list[ObjectDetection]]:
    """Return, for each view, the detections of no class of the instances of which a mask was trimmed.

    Args:
        views: Images without flying pixels, with camera poses.
        rows: Associated detections of each view.
        ids: Instances that are examined.
    """
    agreed: list[list[ObjectDetection]] = [[] for _ in views]
    for id in sorted(ids):
        seen = {k: d for k, row in enumerate(rows) for d in row if d.instance_id == id}
        if len(seen) < VIEWS:
            continue
        wide = {k: cv2.dilate(d.mask.astype(np.uint8), _BORDER) > 0 for k, d in seen.items()}
        masks = {k: _agreed(views, k, d.mask, wide) for k, d in seen.items()}
        if all(masks[k] is d.mask for k, d in seen.items()):
            continue
        for k, d in seen.items():
            if masks[k].any():
                agreed[k].append(replace(unclassified(masks[k], id), support=d.support))
    return agreed


def _agreed(views: Sequence[RgbdFrame], k: int, mask: Mask, wide: dict[int, Mask]) -> Mask:
    """Return the mask in one view without what the others exclude; the mask itself if that is little."""
    measured = mask & (views[k].depth > 0)
    points = points_of(views[k], measured)
    inside, outside = np.zeros(len(points), int), np.zeros(len(points), int)
    for other, own in wide.items():
        if other == k:
            continue
        is_seen, is_own = _votes(views[other], own, points)
        inside += is_seen & is_own
        outside += is_seen & ~is_own
    is_excluded = (outside >= VOTES) & (outside > inside)
    if is_excluded.sum() <= TRIMMED * max(len(points), 1):
        return mask
    kept = measured.copy()
    kept[measured] = ~is_excluded
    kept = (cv2.morphologyEx(kept.astype(np.uint8), cv2.MORPH_OPEN, _BORDER) > 0) & mask
    return kept if kept.sum() >= LEFT * mask.sum() else np.zeros_like(mask)


def _votes(
    view: RgbdFrame, own: Mask, points: Float[np.ndarray, "n 3"]
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Return which world points [m] a view sees, and which of them are in its mask."""
    pixels, depth = project(view, points)
    is_seen = in_image(view, pixels, depth)
    u, v = np.where(is_seen[:, None], pixels, 0).T
    is_seen &= np.abs(view.depth[v, u] - depth) < SAME_SURFACE
    return is_seen, own[v, u]
