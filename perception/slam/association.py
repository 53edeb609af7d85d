"""Data association: masks with landmarks, by the previous frame's masks first, then by rendered masks.

NodeSLAM, section "Data association and Object Initialisation". In addition the measured points of a mask must
lie within the landmark's bounding sphere, so that masks that swap labels or jump to a neighbouring object are
not associated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from perception.geometry import transform_points
from perception.inference.observation import pixel_rays
from perception.rendering.multi_object import PairRenderer, RayPairs, nearest_pair
from perception.rendering.pose import canonical_from_camera
from perception.slam.bounding_spheres import BoundingSpheres
from perception.slam.labelled_frame import BACKGROUND, LabelImage, LabelledFrame
from perception.slam.landmarks import LandmarkMap
from perception.types import RgbdFrame

_NO_LANDMARK = -1
_SAMPLE_FACTOR = 1.5  # samples of mask rendering are sparser than those of tracking by this factor
_NEAREST_OBJECT = 0.1  # [m] objects with centres nearer to the image plane are not rendered
_FAR = 1e3  # [m] depth of pairs of ray and object that miss
_PREVIOUS_PITCH = 2  # subsampling of the comparison with the previous masks, in pixels


@dataclass(frozen=True)
class MaskAssociationConfig:
    """Thresholds of the association of masks with landmarks.

    Attributes:
        min_iou: Least intersection over union with the previous frame's mask, or with the rendered mask.
        position_margin: Largest distance of the median mask point outside the landmark's bounding sphere, in
            metres.
        part_ratio: Share of a mask inside a landmark's rendered mask above which it is a part of it.
        pitch: Subsampling of the rendered masks, in pixels.
        depth_margin: Depth difference between a measurement and a landmark's surface that is attributed to
            noise, in metres.
        min_pixels: Least number of rendered pixels for which a see-through ratio is computed.
    """

    min_iou: float = 0.2
    position_margin: float = 0.03
    part_ratio: float = 0.5
    pitch: int = 4
    depth_margin: float = 0.012
    min_pixels: int = 15


@dataclass(frozen=True)
class RenderedMasks:
    """Rendered masks of the map on a subsampled pixel grid.

    Attributes:
        landmark_ids: Id of the nearest landmark at each pixel, -1 for none.
        depth: Rendered depth in metres, 0 where no landmark is hit.
        sigma: Standard deviation of the rendered depth, in metres.
        n_unoccluded: Number of pixels of each landmark if nothing occluded it, by id.
        n_visible: Number of pixels of each landmark that no other landmark occludes, by id.
        pitch: Subsampling of the grid, in image pixels.
    """

    landmark_ids: Int[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    sigma: Float[np.ndarray, "h w"]
    n_unoccluded: Mapping[int, int]
    n_visible: Mapping[int, int]
    pitch: int


def associate_masks(
    view: LabelledFrame,
    previous: LabelledFrame | None,
    render: Callable[[], RenderedMasks],
    world: LandmarkMap,
    config: MaskAssociationConfig = MaskAssociationConfig(),
) -> dict[int, int]:
    """Return the landmark id of every label that has one; several masks may be parts of one landmark.

    Args:
        view: Masks of the frame, with the predicted camera pose.
        previous: The previous frame with its association, if it was tracked.
        render: Renders the masks of the map; called only if the previous masks leave labels unmatched.
        world: The map.
        config: Thresholds.
    """
    labels = view.labels
    candidates = _candidates(view, world, config)
    matches: dict[int, int] = {}
    if previous is not None and previous.labels.shape == labels.shape:
        ids = np.full(256, _NO_LANDMARK)
        for label, id in previous.landmark_of.items():
            ids[label] = id
        small = (slice(None, None, _PREVIOUS_PITCH),) * 2
        matches = _assign(labels[small], ids[previous.labels[small]], candidates, config.min_iou)
    unmatched = {label for label in candidates if label not in matches}
    if unmatched:
        taken = set(matches.values())
        remaining = {label: candidates[label] - taken for label in unmatched}
        coarse, ids = labels[:: config.pitch, :: config.pitch], render().landmark_ids
        matches |= _assign(coarse, ids, remaining, config.min_iou)
        for label in unmatched - set(matches):
            inside = ids[coarse == label]
            for id in candidates[label]:
                if len(inside) and (inside == id).mean() > config.part_ratio:
                    matches[label] = id
    return matches


def _candidates(
    view: LabelledFrame, world: LandmarkMap, config: MaskAssociationConfig
) -> dict[int, set[int]]:
    """Return for each label with depth the landmarks near the median of its points."""
    v, u = np.nonzero((view.labels != BACKGROUND)[:: config.pitch, :: config.pitch])
    v, u = config.pitch * v, config.pitch * u
    z = view.frame.depth[v, u]
    label_of_point = view.labels[v, u]
    points = transform_points(view.T_world_camera, pixel_rays(view.frame, u, v) * z[:, None])
    landmarks = [world.landmarks[id] for id in world.ids]
    centres = np.array([landmark.state.pose.translation for landmark in landmarks]).reshape(-1, 3)
    radii = np.array([landmark.bounding_radius for landmark in landmarks]) + config.position_margin
    candidates = {}
    for label in np.unique(label_of_point):
        own = points[(label_of_point == label) & (z > 0)]
        if not len(own):
            continue
        near = np.linalg.norm(centres - np.median(own, axis=0), axis=1) < radii
        candidates[int(label)] = {world.ids[k] for k in np.flatnonzero(near)}
    return candidates


def _assign(
    labels: Int[np.ndarray, "h w"] | LabelImage,
    ids: Int[np.ndarray, "h w"],
    candidates: Mapping[int, set[int]],
    min_iou: float,
) -> dict[int, int]:
    """Return the one-to-one assignment of labels to landmark ids with the largest total IoU.

    Args:
        labels: Label image.
        ids: Landmark id of each pixel, -1 for none.
        candidates: Landmarks that each label may be assigned to.
        min_iou: Least IoU of an assigned pair.
    """
    wanted = [label for label, options in candidates.items() if options]
    present = [int(id) for id in np.unique(ids) if id >= 0]
    if not wanted or not present:
        return {}
    row = np.zeros(256, np.int64)
    row[wanted] = np.arange(1, len(wanted) + 1)
    column = np.zeros(max(present) + 2, np.int64)
    column[present] = np.arange(1, len(present) + 1)  # index -1, no landmark, is the last entry
    width = len(present) + 1
    pairs = row[labels] * width + column[ids]
    count = np.bincount(pairs.ravel(), minlength=(len(wanted) + 1) * width).reshape(-1, width)
    both = count[1:, 1:]
    union = count[1:].sum(axis=1)[:, None] + count[:, 1:].sum(axis=0) - both
    iou = both / np.maximum(union, 1)
    for r, label in enumerate(wanted):
        for c, id in enumerate(present):
            if id not in candidates[label]:
                iou[r, c] = 0.0
    rows, columns = linear_sum_assignment(-iou)
    return {wanted[r]: present[c] for r, c in zip(rows, columns) if iou[r, c] > min_iou}


def render_masks(
    world: LandmarkMap, frame: RgbdFrame, T_world_camera: Float[np.ndarray, "4 4"], pitch: int = 4
) -> RenderedMasks:
    """Render the masks of all landmarks, the nearest in front.

    Args:
        world: The map.
        frame: Its intrinsics are used; its own pose is not.
        T_world_camera: Pose to render from.
        pitch: Subsampling of the image, in pixels.
    """
    height, width = frame.depth.shape
    u, v = np.meshgrid(np.arange(0, width, pitch), np.arange(0, height, pitch))
    shape = u.shape
    directions = pixel_rays(frame, u.ravel(), v.ravel())
    nearest, depth, sigma = np.full(u.size, _NO_LANDMARK), np.zeros(u.size), np.zeros(u.size)
    if not world.ids:
        empty = np.zeros(shape)
        return RenderedMasks(nearest.reshape(shape), empty, empty, {}, {}, pitch)
    landmarks = [world.landmarks[id] for id in world.ids]
    spheres = BoundingSpheres.of(world, T_world_camera)
    ray, k = np.nonzero(spheres.hit_by(directions) & (spheres.centres[:, 2] > _NEAREST_OBJECT))
    step = _SAMPLE_FACTOR * np.array([landmark.sample_distance for landmark in landmarks])
    rays, compact = np.unique(ray, return_inverse=True)
    pairs = RayPairs(directions[rays], compact, k, spheres.depth_range, step)
    A = np.concatenate([canonical_from_camera(x.state.pose, T_world_camera[None]) for x in landmarks])
    image = PairRenderer(world.stack, pairs, gradients=False, threads=2)(A)
    hit = image.mask > 0.5
    ids = np.array(world.ids)
    if len(rays):
        shown = nearest_pair(pairs, np.ones(len(k), bool), np.where(hit, image.depth, _FAR), image.mask)
        nearest[rays] = np.where(hit[shown], ids[k[shown]], _NO_LANDMARK)
        depth[rays] = np.where(hit[shown], image.depth[shown], 0.0)
        sigma[rays] = np.sqrt(image.variance[shown])
    return RenderedMasks(
        landmark_ids=nearest.reshape(shape),
        depth=depth.reshape(shape),
        sigma=sigma.reshape(shape),
        n_unoccluded={int(id): int((hit & (k == i)).sum()) for i, id in enumerate(ids)},
        n_visible={int(id): int((nearest == id).sum()) for id in ids},
        pitch=pitch,
    )


def see_through_ratios(
    rendered: RenderedMasks, frame: RgbdFrame, config: MaskAssociationConfig = MaskAssociationConfig()
) -> dict[int, float]:
    """Return for each landmark the share of its visible pixels that measure a depth clearly behind it.

    Pixels without a measurement, or with one in front of the landmark, are not counted; landmarks with fewer
    than ``config.min_pixels`` others are omitted.
    """
    measured = frame.depth[:: rendered.pitch, :: rendered.pitch]
    margin = config.depth_margin
    counted = (rendered.landmark_ids >= 0) & (measured > 0) & (measured > rendered.depth - margin)
    behind = counted & (measured > rendered.depth + margin + 2 * rendered.sigma)
    ratios = {}
    for id in np.unique(rendered.landmark_ids[counted]):
        own = counted & (rendered.landmark_ids == id)
        if own.sum() >= config.min_pixels:
            ratios[int(id)] = float(behind[own].mean())
    return ratios
