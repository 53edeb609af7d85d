"""Two objects of different colour in one mask: one of them above the other.

Where a small bowl stands in a mug, the outline of both has hardly a seam. Pixels are parted in two groups by
their colour, those of all views together. A cut between them is a hypothesis, as a seam is: single objects
have labels, caps and glazes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2

from perception.detection.instances import remove_specks
from perception.geometry import transform_points
from perception.inference.observation import ObjectObservation, pixel_rays
from perception.types import SupportPlane

LIGHTNESS = 0.3  # weight of the lightness, which shading changes, relative to both other axes of CIELAB
LEAST_CONTRAST = 15.0  # between the mean colours of both groups, in CIELAB
DISTINCT = 2.0  # the same, in standard deviations of the colours of a group
WHOLE = 0.6  # least share of a group's pixels that are in one piece: a handle parts a bowl below it
HIGHER = 0.01  # [m] by which lowest and mean point of the upper group are above those of the lower one
SPECK = 0.05  # smallest separate piece of a group, as a share of its largest
_LOWEST = 0.05  # quantile of the heights that is the lowest point of a group
_SMOOTH = 5  # pixels across the window in which the majority decides
_SAMPLES = 6000  # pixels of all views whose colours are grouped
_ENDS = 0.05, 0.95  # quantiles along each principal axis of the colours, at which the groups begin
_FEWEST = 100  # measured points of a group


@dataclass(frozen=True)
class ColorCut:
    """An instance parted by colour.

    Attributes:
        masks: pixels of the lower and of the upper object in each view.
        height: height of the lowest visible point of the upper one above the plane, in metres.
    """

    masks: Mapping[int, tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]]
    height: float


def color_cut(seen: Mapping[int, ObjectObservation], plane: SupportPlane) -> ColorCut | None:
    """Return the cut of an instance between its two colours; None if it has not two, one above the other.

    Args:
        seen: the instance in each view, by the number of the view.
        plane: its support plane.
    """
    groups = _color_groups(seen)
    if groups is None:
        return None
    heights = [
        np.concatenate([_heights(view, groups[k][g], plane) for k, view in seen.items()]) for g in (0, 1)
    ]
    if min(len(h) for h in heights) < _FEWEST:
        return None
    upper = int(heights[1].mean() > heights[0].mean())
    low, high = heights[1 - upper], heights[upper]
    lowest = float(np.quantile(high, _LOWEST))
    if min(lowest - float(np.quantile(low, _LOWEST)), float(high.mean() - low.mean())) < HIGHER:
        return None
    masks = {k: (_tidy(g[1 - upper]), _tidy(g[upper])) for k, g in groups.items()}
    return ColorCut(masks, lowest)


def color_pieces(
    seen: Mapping[int, ObjectObservation],
) -> Mapping[int, tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]] | None:
    """Return the two pieces of an instance of two colours in each view; None if it has not two.

    Small spots of the other colour belong to the piece that they are in.

    Args:
        seen: the instance in each view, by the number of the view.
    """
    groups = _color_groups(seen)
    if groups is None:
        return None
    large = {k: (_tidy(one), _tidy(other)) for k, (one, other) in groups.items()}
    return {k: (_tidy(seen[k].mask & ~b), _tidy(seen[k].mask & ~a)) for k, (a, b) in large.items()}


def _color_groups(
    seen: Mapping[int, ObjectObservation],
) -> dict[int, tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]] | None:
    """Return the pixels of both colours in each view; None if there are not two, each about in one piece."""
    colors = {k: _colors(view) for k, view in seen.items()}
    means = _two_means(np.concatenate([colors[k][view.mask] for k, view in seen.items()]))
    if means is None:
        return None
    groups: dict[int, tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]] = {}
    for k, view in seen.items():
        nearer = np.linalg.norm(colors[k][:, :, None] - means, axis=-1).argmin(axis=-1)
        votes = np.where(view.mask, 2.0 * nearer - 1.0, 0.0)
        second = cv2.blur(votes, (_SMOOTH, _SMOOTH)) > 0
        groups[k] = (view.mask & ~second, view.mask & second)
    if any(_largest_piece([masks[g] for masks in groups.values()]) < WHOLE for g in (0, 1)):
        return None
    return groups


def _colors(view: ObjectObservation) -> Float[np.ndarray, "h w 3"]:
    """Return the colours of an image in CIELAB, the lightness with a smaller weight."""
    lab = cv2.cvtColor(view.frame.rgb.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
    return lab * np.array([LIGHTNESS, 1.0, 1.0], np.float32)


def _two_means(colors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 3"] | None:
    """Return the mean colours of two groups; None if these are not distinct."""
    if len(colors) < _FEWEST:
        return None
    sample = colors[:: max(1, len(colors) // _SAMPLES)].astype(np.float64)
    best: tuple[float, Float[np.ndarray, "2 3"]] | None = None
    for axis in np.linalg.eigh(np.cov(sample.T))[1].T:
        order = np.argsort(sample @ axis)
        ends = sample[order[[round(q * (len(order) - 1)) for q in _ENDS]]]
        if np.linalg.norm(ends[1] - ends[0]) < LEAST_CONTRAST / 2:
            continue
        means, group = kmeans2(sample, ends, minit="matrix")
        deviation = float(np.sqrt(np.square(sample - means[group]).sum(axis=1).mean()))
        if best is None or deviation < best[0]:
            best = deviation, means
    if best is None:
        return None
    deviation, means = best
    apart = float(np.linalg.norm(means[1] - means[0]))
    return means if apart > max(LEAST_CONTRAST, DISTINCT * deviation) else None


def _largest_piece(masks: list[Bool[np.ndarray, "h w"]]) -> float:
    """Return the share of the pixels of a group that are in the largest piece of their image."""
    total, largest = 0, 0
    for mask in masks:
        if mask.any():
            stats = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)[2]
            total += int(mask.sum())
            largest += int(stats[1:, cv2.CC_STAT_AREA].max())
    return largest / max(total, 1)


def _heights(
    view: ObjectObservation, mask: Bool[np.ndarray, "h w"], plane: SupportPlane
) -> Float[np.ndarray, "n"]:
    """Return the heights [m] of the measured points of a mask above the plane."""
    v, u = np.nonzero(mask & (view.frame.depth > 0))
    points = pixel_rays(view.frame, u, v) * view.frame.depth[v, u][:, None].astype(np.float64)
    return plane.height_above(transform_points(view.T_world_camera, points))


def _tidy(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    return remove_specks(mask, SPECK) if mask.any() else mask
