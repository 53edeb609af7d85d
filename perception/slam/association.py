"""Which mask shows which landmark: by the previous frame's masks first, then by those the map renders.

NodeSLAM, section "Data association and Object Initialisation". A match must also lie where its landmark is:
masks that swap names, or jump to a neighbour, must not pull the map along.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.optimize import linear_sum_assignment

from perception.geometry import invert, transform_points
from perception.inference.observation import pixel_rays
from perception.rendering.multi_object import PairRenderer, RayPairs, nearest_pair
from perception.rendering.pose import canonical_from_camera
from perception.slam.landmarks import LandmarkMap
from perception.types import RgbdFrame

LabelImage = UInt8[np.ndarray, "h w"]


@dataclass(frozen=True)
class AssociationConfig:
    """When a mask is a landmark's.

    Attributes:
        min_iou: with the previous frame's mask, or the rendered one.
        slack: how far outside the landmark's sphere the middle of the mask's points may lie [m].
        part: a mask that lies in a landmark's rendered mask with this share is a part of it.
        pitch: the rendered masks are this many times smaller than the image.
        behind: what is measured so far behind a landmark's surface cannot be it [m].
        least_pixels: of a rendered mask, to judge by.
    """

    min_iou: float = 0.2
    slack: float = 0.03
    part: float = 0.5
    pitch: int = 4
    behind: float = 0.012
    least_pixels: int = 15


@dataclass(frozen=True)
class RenderedMasks:
    """What the map expects to see, on a coarse grid.

    Attributes:
        index: (h, w) landmark id of each pixel, -1 for none.
        depth: (h, w) of what is rendered there [m], 0 for none.
        sigma: (h, w) its uncertainty [m].
        whole: for each landmark in view its pixels without occlusion.
        visible: for each the pixels that nothing of the map hides.
        pitch: pixels of the image for each one here.
    """

    index: Int[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    sigma: Float[np.ndarray, "h w"]
    whole: Mapping[int, int]
    visible: Mapping[int, int]
    pitch: int


def associate_masks(
    frame: RgbdFrame,
    labels: LabelImage,
    previous: tuple[LabelImage, Mapping[int, int]] | None,
    render: Callable[[], RenderedMasks],
    world: LandmarkMap,
    config: AssociationConfig = AssociationConfig(),
) -> dict[int, int]:
    """Label to landmark for every mask that has one; several masks may be parts of one landmark.

    Args:
        frame: with about the camera's pose.
        labels: the masks.
        previous: the last frame's label image and its association.
        render: what the map expects; called only where previous masks leave something open.
        world: the map.
        config: thresholds.
    """
    allowed = _allowed(frame, labels, world, config)
    matches: dict[int, int] = {}
    if previous is not None and previous[0].shape == labels.shape:
        ids = np.full(256, -1)
        for label, landmark in previous[1].items():
            ids[label] = landmark
        small = (slice(None, None, 2),) * 2
        matches = _matched(labels[small], ids[previous[0][small]], allowed, config.min_iou)
    left = {label for label in allowed if label not in matches}
    if left:
        taken = set(matches.values())
        open_pairs = {label: allowed[label] - taken for label in left}
        coarse, index = labels[:: config.pitch, :: config.pitch], render().index
        matches |= _matched(coarse, index, open_pairs, config.min_iou)
        for label in left - set(matches):
            inside = index[coarse == label]
            for one in allowed[label]:
                if len(inside) and (inside == one).mean() > config.part:
                    matches[label] = one
    return matches


def _allowed(
    frame: RgbdFrame, labels: LabelImage, world: LandmarkMap, config: AssociationConfig
) -> dict[int, set[int]]:
    """For each label the landmarks that its points lie at."""
    assert frame.T_world_camera is not None
    v, u = np.nonzero((labels != 0)[:: config.pitch, :: config.pitch])
    v, u = config.pitch * v, config.pitch * u
    z = frame.depth[v, u]
    label = labels[v, u]
    points = transform_points(frame.T_world_camera, pixel_rays(frame, u, v) * z[:, None])
    centres = np.array([world.landmarks[i].state.pose.translation for i in world.ids]).reshape(-1, 3)
    reach = np.array([world.landmarks[i].reach for i in world.ids]) + config.slack
    allowed = {}
    for one in np.unique(label):
        own = points[(label == one) & (z > 0)]
        if not len(own):
            continue
        near = np.linalg.norm(centres - np.median(own, axis=0), axis=1) < reach
        allowed[int(one)] = {world.ids[k] for k in np.flatnonzero(near)}
    return allowed


def _matched(
    labels: np.ndarray, ids: np.ndarray, allowed: Mapping[int, set[int]], min_iou: float
) -> dict[int, int]:
    """The one-to-one assignment of labels to landmark ids with the most overlap, none under the threshold."""
    wanted = [label for label, options in allowed.items() if options]
    known = [int(i) for i in np.unique(ids) if i >= 0]
    if not wanted or not known:
        return {}
    row = np.zeros(256, np.int64)
    row[wanted] = np.arange(1, len(wanted) + 1)
    column = np.zeros(max(known) + 2, np.int64)
    column[known] = np.arange(1, len(known) + 1)  # the last entry stands for -1
    width = len(known) + 1
    pairs = row[labels] * width + column[ids]
    count = np.bincount(pairs.ravel(), minlength=(len(wanted) + 1) * width).reshape(-1, width)
    both = count[1:, 1:]
    union = count[1:].sum(axis=1)[:, None] + count[:, 1:].sum(axis=0) - both
    iou = both / np.maximum(union, 1)
    for r, label in enumerate(wanted):
        for c, one in enumerate(known):
            if one not in allowed[label]:
                iou[r, c] = 0.0
    rows, columns = linear_sum_assignment(-iou)
    return {wanted[r]: known[c] for r, c in zip(rows, columns) if iou[r, c] > min_iou}


def render_masks(
    world: LandmarkMap, frame: RgbdFrame, T_world_camera: Float[np.ndarray, "4 4"], pitch: int = 4
) -> RenderedMasks:
    """Renders the landmarks' masks on every ``pitch``-th pixel; the least depth wins."""
    height, width = frame.depth.shape
    u, v = np.meshgrid(np.arange(0, width, pitch), np.arange(0, height, pitch))
    shape = u.shape
    directions = pixel_rays(frame, u.ravel(), v.ravel())
    index, depth, sigma = np.full(u.size, -1), np.zeros(u.size), np.zeros(u.size)
    if not world.ids:
        blank = np.zeros(shape)
        return RenderedMasks(index.reshape(shape), blank, blank, {}, {}, pitch)
    landmarks = [world.landmarks[i] for i in world.ids]
    T_camera_world = invert(T_world_camera)
    centres = np.array([one.state.pose.translation for one in landmarks])
    centres = centres @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    reach = np.array([one.reach for one in landmarks])
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    along = unit @ centres.T
    miss2 = (centres**2).sum(axis=1) - along**2
    ray, k = np.nonzero((along > 0) & (miss2 < reach**2) & (centres[:, 2] > 0.1))
    z = centres[:, 2]
    ranges = np.stack([np.maximum(z - reach, 0.02), np.maximum(z + reach, 0.05)], axis=1)
    step = 1.5 * np.array([one.sample_distance for one in landmarks])
    rays, compact = np.unique(ray, return_inverse=True)
    pairs = RayPairs(directions[rays], compact, k, ranges, step)
    A = np.concatenate([canonical_from_camera(one.state.pose, T_world_camera[None]) for one in landmarks])
    image = PairRenderer(world.stack, pairs, gradients=False, threads=2)(A)
    hit = image.mask > 0.5
    ids = np.array(world.ids)
    if len(rays):
        shown = nearest_pair(pairs, np.ones(len(k), bool), np.where(hit, image.depth, 1e3), image.mask)
        index[rays] = np.where(hit[shown], ids[k[shown]], -1)
        depth[rays] = np.where(hit[shown], image.depth[shown], 0.0)
        sigma[rays] = np.sqrt(image.variance[shown])
    whole = {int(ids[i]): int((hit & (k == i)).sum()) for i in range(len(ids))}
    visible = {one: int((index == one).sum()) for one in whole}
    return RenderedMasks(
        index.reshape(shape), depth.reshape(shape), sigma.reshape(shape), whole, visible, pitch
    )


def seen_through(
    rendered: RenderedMasks, frame: RgbdFrame, config: AssociationConfig = AssociationConfig()
) -> dict[int, float]:
    """Of each landmark's visible pixels the share at which the camera sees what is clearly behind it.

    Pixels that measure nothing, or something in front, say nothing; landmarks with few others are left out.
    """
    measured = frame.depth[:: rendered.pitch, :: rendered.pitch]
    says = (rendered.index >= 0) & (measured > 0) & (measured > rendered.depth - config.behind)
    behind = says & (measured > rendered.depth + config.behind + 2 * rendered.sigma)
    shares = {}
    for one in np.unique(rendered.index[says]):
        own = says & (rendered.index == one)
        if own.sum() >= config.least_pixels:
            shares[int(one)] = float(behind[own].mean())
    return shares
