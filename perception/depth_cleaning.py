"""Removal of depth that no surface explains: flying pixels at edges and isolated pixels.

At the outline of an object a depth pixel covers two surfaces; sensors and their filters return a depth
between them. Such a pixel differs from the neighbours on both sides, towards the near one in one direction
and towards the far one in the other. A surface does that only if it is seen at almost grazing incidence.
"""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.types import CameraIntrinsics, RgbdFrame

MAX_TANGENT = 7.0  # of the angle of incidence (82 degrees) up to which neighbours count as one surface
MIN_TOLERANCE = 0.007  # [m]
NOISE = 0.008  # [1/m] tolerance of the depth per squared depth, for the noise of distant surfaces
SUPPORT = 2.0  # tolerance of a supporting neighbour, in tolerances of a step: noise isolates no pixel
MIN_SUPPORT = 3  # of eight neighbours on the same surface; a corner of a thin part has three
BAND = 40  # rows processed at once: they stay in the cache
Window = tuple[slice, slice]
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (rows, columns)


def clean_depth(depth: Float[np.ndarray, "h w"], intrinsics: CameraIntrinsics) -> Float[np.ndarray, "h w"]:
    """Return the depth image in [m] without flying and isolated pixels, which become 0.

    A pixel flies if, along a row, a column or a diagonal, depth rises or falls by more than a surface at
    82 degrees of incidence (and more than noise) from one neighbour to it and again to the next.
    """
    cleaned = np.empty(depth.shape, dtype=np.float32)
    for top in range(0, len(depth), BAND):
        start, stop = max(top - 1, 0), min(top + BAND + 1, len(depth))
        kept = _explained(depth[start:stop], intrinsics.fx)[top - start :][:BAND]
        np.multiply(depth[top : top + BAND], kept, out=cleaned[top : top + BAND])
    return cleaned


def _explained(depth: Float[np.ndarray, "h w"], focal: float) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that are neither flying nor isolated."""
    tolerance = depth * np.maximum(np.float32(MAX_TANGENT / focal), np.float32(NOISE) * depth)
    np.maximum(tolerance, np.float32(MIN_TOLERANCE), out=tolerance)
    between = np.zeros(depth.shape, dtype=bool)
    support = np.zeros(depth.shape, dtype=np.uint8)
    for rows, columns in DIRECTIONS:
        _compare(depth, tolerance, rows, columns, between, support)
    return ~between & (support >= MIN_SUPPORT)


def _compare(
    depth: Float[np.ndarray, "h w"],
    tolerance: Float[np.ndarray, "h w"],
    rows: int,
    columns: int,
    between: Bool[np.ndarray, "h w"],
    support: UInt8[np.ndarray, "h w"],
) -> None:
    """Update both images by the neighbours in one direction and its opposite."""
    first, second = _halves(depth.shape, rows, columns)
    step = depth[second] - depth[first]
    limit = tolerance[first] * np.float32(np.hypot(rows, columns))
    measured = (depth[first] > 0) & (depth[second] > 0)
    away, closer = (step > limit) & measured, (step < -limit) & measured
    same = (measured & (np.abs(step) <= SUPPORT * limit)).view(np.uint8)
    support[first] += same
    support[second] += same
    before, after = _halves(step.shape, rows, columns)
    middle = between[second][before]  # the pixel between two successive steps
    middle |= (away[before] & away[after]) | (closer[before] & closer[after])


def _halves(shape: tuple[int, ...], rows: int, columns: int) -> tuple[Window, Window]:
    """Return the windows of all pixels with a neighbour ``rows`` down and ``columns`` right, and of those."""
    height, width = shape
    down, right = slice(rows, height), slice(max(columns, 0), width + min(columns, 0))
    up, left = slice(0, height - rows), slice(max(-columns, 0), width - max(columns, 0))
    return (up, left), (down, right)


_cleaned: WeakKeyDictionary[RgbdFrame, RgbdFrame] = WeakKeyDictionary()


def clean_frame(frame: RgbdFrame) -> RgbdFrame:
    """Return the frame with its depth cleaned, which is done once for each frame."""
    cleaned = _cleaned.get(frame)
    if cleaned is None:
        cleaned = _cleaned[frame] = replace(frame, depth=clean_depth(frame.depth, frame.intrinsics))
    return cleaned


def beside_jumps(
    pixels: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"], jump: float
) -> Bool[np.ndarray, "h w"]:
    """Return which of some pixels are beside a step of depth of at least ``jump`` [m] to another of them."""
    kernel = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(np.where(pixels, depth, np.float32(np.inf)).astype(np.float32), kernel)
    farthest = cv2.dilate(np.where(pixels, depth, np.float32(0)).astype(np.float32), kernel)
    return pixels & (farthest - nearest >= jump)
