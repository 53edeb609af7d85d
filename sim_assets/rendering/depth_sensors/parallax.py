"""What a second eye beside the camera sees: forward warping along rows with the nearer surface in front."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

UNSEEN = -1e6  # column of a pixel that no surface is warped to


def warp_targets(disparity: Float[np.ndarray, "h w"], margin: int) -> tuple[Int[np.ndarray, "h w"], int]:
    """Return the flat index of each pixel in an eye to the right of the camera, and that image's width.

    Args:
        disparity: shift of each pixel in [px]; pixel x appears at column x - disparity.
        margin: columns by which the other eye's image is wider on the left; beyond the image the index is
            that of the outermost column.
    """
    height, width = disparity.shape
    wide = width + margin
    columns = np.rint(np.arange(margin, wide, dtype=np.float32) - disparity).astype(np.int32)
    np.clip(columns, 0, wide - 1, out=columns)
    columns += (np.arange(height, dtype=np.int32) * wide)[:, None]
    return columns, wide


def source_columns(disparity: Float[np.ndarray, "h w"], margin: int) -> Float[np.ndarray, "h w2"]:
    """Return for each pixel of the right eye the column of the left image that it shows (UNSEEN if none).

    The right image is wider by ``margin`` columns on its left. Of surfaces that meet in one pixel, the one
    from farther right is nearer and is written last.
    """
    disparity = np.ascontiguousarray(disparity)  # the order of assignment below decides
    targets, wide = warp_targets(disparity, margin)
    columns = np.arange(disparity.shape[1], dtype=np.float32)
    slope = np.zeros_like(disparity)
    slope[:, 1:-1] = (disparity[:, 2:] - disparity[:, :-2]) / 2
    slope[np.abs(slope) > 0.5] = 0
    exact = columns - disparity
    source = np.full((len(disparity), wide), UNSEEN, dtype=np.float32)
    source.ravel()[targets] = columns + (np.rint(exact) - exact) / (1 - slope)
    return _without_cracks(source)


def _without_cracks(source: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Fill single columns that a stretched surface left open."""
    between = (source[:, 2:] + source[:, :-2]) / 2
    open_ = (source[:, 1:-1] == UNSEEN) & (between > UNSEEN / 4)
    open_ &= np.abs(source[:, 2:] - source[:, :-2]) < 4
    source[:, 1:-1][open_] = between[open_]
    return source


def hidden_from(disparity: Float[np.ndarray, "h w"], slack: float = 1.5) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that an eye beside the camera does not see because a nearer surface covers them.

    Args:
        disparity: shift of each pixel in that eye in [px], positive for one to the right of the camera,
            negative for one to the left.
        slack: difference of disparity up to which pixels count as one surface.
    """
    if disparity.size and disparity.min() < 0:
        return hidden_from(-disparity[:, ::-1], slack)[:, ::-1]
    disparity = np.ascontiguousarray(disparity)  # the order of assignment below decides
    height, width = disparity.shape
    if not disparity.size:
        return np.zeros((height, width), dtype=bool)
    targets, wide = warp_targets(disparity, int(np.ceil(disparity.max())) + 1)
    nearest = np.zeros((height, wide), dtype=np.float32)
    nearest.ravel()[targets] = disparity
    # A near surface seen at a slant leaves columns open through which the far one would be seen.
    nearest = cv2.morphologyEx(nearest, cv2.MORPH_CLOSE, np.ones((1, 3), np.uint8))
    return nearest.ravel()[targets] > disparity + np.float32(slack)
