"""Object instances from geometry: what stands out of the support plane, separated in the plan view.

Points above the plane fall into plan-view cells; connected cells are one instance. Fragments that touch in
the image without a step in depth (an object half hidden behind another, thin parts that skip a cell) are
joined. Masks then grow down to the plane, over holes in the depth, and one pixel outwards: a mask too wide
costs a fit far less than one too narrow.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from perception.detection.geometry import height_image, plan_coordinates, points_of, window_of
from perception.types import RgbdFrame, SupportPlane

_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class SegmentationConfig:
    """What counts as an object.

    Attributes:
        cell: side of a plan-view cell in [m].
        min_height, max_height: bounds in [m] of the height at which a point surely stands out; between
            them four standard deviations of the plane's own noise decide.
        ceiling: instances that reach higher above the plane in [m] are no table-top objects (an arm).
        near: points closer to the camera in [m] are left out (the gripper).
        depth_step: neighbouring pixels closer in depth than this in [m] touch.
        contact: touching pixel pairs that join two plan-view fragments.
        min_area: smallest visible area facing the camera in [m^2].
        min_pixels: smallest mask.
        grow: how far in pixels a mask may grow down to the plane.
        margin: how far in pixels a mask is finally widened.
    """

    cell: float = 0.005
    min_height: float = 0.004
    max_height: float = 0.010
    ceiling: float = 0.40
    near: float = 0.15
    depth_step: float = 0.008
    contact: int = 12
    min_area: float = 3e-4
    min_pixels: int = 60
    grow: int = 6
    margin: int = 1


def segment(
    frame: RgbdFrame, plane: SupportPlane, config: SegmentationConfig = SegmentationConfig()
) -> list[Bool[np.ndarray, "h w"]]:
    """Masks of the instances standing on the plane, largest first; they do not overlap.

    Objects cut by the image border are included. Whether an instance is of any class is not decided here.
    """
    depth = cv2.medianBlur(np.ascontiguousarray(frame.depth), 5)
    height = height_image(frame, plane, depth)
    measured = depth > config.near
    noise = _plane_noise(height, measured)
    surely = float(np.clip(4.0 * noise, config.min_height, config.max_height))
    foreground = measured & (height > surely)
    labels = _plan_components(frame, plane, depth, foreground, config)
    labels = _joined_in_image(labels, depth, config)
    keep = _plausible(labels, depth, height, frame.intrinsics.fx * frame.intrinsics.fy, config)
    weak = (measured & (height > min(max(5 * noise, 0.4 * surely), surely))) | (frame.depth == 0) & (
        depth == 0
    )
    return _grown(labels, keep, weak, config)


def _plane_noise(height: Float[np.ndarray, "h w"], measured: Bool[np.ndarray, "h w"]) -> float:
    """Robust standard deviation in [m] of the heights of the plane's own pixels; 1 mm if none is in view."""
    sample = height[::4, ::4][measured[::4, ::4]]
    near_plane = np.abs(sample[np.abs(sample) < 0.01])
    return 1.4826 * float(np.median(near_plane)) if len(near_plane) >= 50 else 0.001


def _plan_components(
    frame: RgbdFrame,
    plane: SupportPlane,
    depth: Float[np.ndarray, "h w"],
    foreground: Bool[np.ndarray, "h w"],
    config: SegmentationConfig,
) -> Int[np.ndarray, "h w"]:
    """Image of component numbers from 1 on; 0 is background."""
    labels = np.zeros(depth.shape, dtype=np.int32)
    if not foreground.any():
        return labels
    plan = plan_coordinates(points_of(frame, foreground, depth), plane)
    reach = np.median(plan, axis=0)
    close = np.abs(plan - reach).max(1) < 3.0  # far background must not blow up the grid
    cells = np.floor((plan - plan[close].min(0)) / config.cell).astype(np.int64)
    width, length = cells[close].max(0) + 1
    flat = np.where(close, cells[:, 0] * length + cells[:, 1], 0)
    count = np.bincount(flat[close], minlength=width * length).reshape(width, length)
    component = cv2.connectedComponents((count >= 2).astype(np.uint8), connectivity=8)[1]
    labels[foreground] = np.where(close, component.ravel()[flat], 0)
    return labels


def _joined_in_image(
    labels: Int[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"], config: SegmentationConfig
) -> Int[np.ndarray, "h w"]:
    """Components merged that touch along at least ``contact`` neighbouring pixels without a depth step."""
    pairs = []
    for a, b in (((slice(None), slice(1, None)), (slice(None), slice(-1))), (np.s_[1:], np.s_[:-1])):
        differ = (labels[a] != labels[b]) & (labels[a] > 0) & (labels[b] > 0)
        differ &= np.abs(depth[a] - depth[b]) < config.depth_step
        pairs.append(np.stack([labels[a][differ], labels[b][differ]], axis=1))
    touching = np.sort(np.concatenate(pairs), axis=1)
    edges, counts = np.unique(touching, axis=0, return_counts=True)
    edges = edges[counts >= config.contact]
    n = int(labels.max()) + 1
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int32)[labels]


def _plausible(
    labels: Int[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    height: Float[np.ndarray, "h w"],
    focal_squared: float,
    config: SegmentationConfig,
) -> list[int]:
    """Numbers of the components of a table-top object's size, largest first. Number 0 is the background."""
    inside = labels > 0
    index = labels[inside]
    n = int(labels.max()) + 1
    pixels = np.bincount(index, minlength=n)
    area = np.bincount(index, weights=depth[inside].astype(np.float64) ** 2, minlength=n) / focal_squared
    too_high = np.bincount(index, weights=height[inside] > config.ceiling, minlength=n)
    keep = (area >= config.min_area) & (pixels >= config.min_pixels) & (too_high < 0.02 * pixels + 1)
    return sorted((int(k) for k in np.flatnonzero(keep)), key=lambda k: -pixels[k])


def _grown(
    labels: Int[np.ndarray, "h w"],
    keep: list[int],
    weak: Bool[np.ndarray, "h w"],
    config: SegmentationConfig,
) -> list[Bool[np.ndarray, "h w"]]:
    """Each kept component grown over weak, unlabelled pixels, then widened; never into another's pixels."""
    free = ~np.isin(labels, keep)
    reach = config.grow + config.margin + 1
    masks = []
    for number in keep:
        window = window_of(labels == number, reach)
        mask = (labels[window] == number).astype(np.uint8)
        allowed = (free[window] & weak[window]).astype(np.uint8)
        for _ in range(config.grow):
            mask = mask | (_dilated(mask) & allowed)
        mask = mask | (_small_holes(mask) & free[window])
        for _ in range(config.margin):
            mask = mask | (_dilated(mask) & free[window])
        result = np.zeros(labels.shape, dtype=bool)
        result[window] = mask.astype(bool)
        free[window] &= ~result[window]
        masks.append(result)
    return masks


def _dilated(mask: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.dilate(mask, _NEIGHBOURS))


def _small_holes(mask: np.ndarray, max_pixels: int = 40) -> np.ndarray:
    """Enclosed gaps of the mask too small to be the opening of a handle."""
    _, holes, stats, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    small = np.asarray(stats)[:, cv2.CC_STAT_AREA] <= max_pixels
    small[0] = False  # number 0 is the mask itself
    return small[np.asarray(holes, dtype=np.int32)].astype(np.uint8)
