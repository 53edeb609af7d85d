"""Things of no class on a support surface, as convex obstacles.

points beside the known objects ──cluster in plan view──▶ things ──carve──▶ solids ──cut──▶ convex pieces
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float, Int

from perception.depth_cleaning import clean_frame
from perception.detection.geometry import plane_axes
from perception.geometry import invert, rigid, transform_points
from perception.obstacles.convex import ConvexConfig, convex_pieces
from perception.obstacles.obstacle import PerceivedObstacle
from perception.obstacles.unexplained import ExplanationConfig, KnownGeometry, unexplained_points
from perception.obstacles.volume import VolumeConfig, solid_of
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

_NO_BOXES = np.zeros((0, 2, 3))


@dataclass(frozen=True)
class ObstacleConfig:
    """Parameters of the search for obstacles; lengths in metres.

    Attributes:
        explanation, volume, convex: Parameters of its steps.
        cell: Side of a cell of the plan view in which points are clustered.
        min_cell_points: Smallest number of points in a cell of a thing, over all views.
        min_points: Smallest number of points of a thing.
        min_extent: Smallest length of a thing along the axis of the plane frame in which it is longest.
        clearance: Distance from known objects that hidden space keeps: objects can be lifted out.
    """

    explanation: ExplanationConfig = field(default_factory=ExplanationConfig)
    volume: VolumeConfig = field(default_factory=VolumeConfig)
    convex: ConvexConfig = field(default_factory=ConvexConfig)
    cell: float = 0.005
    min_cell_points: int = 6
    min_points: int = 300
    min_extent: float = 0.012
    clearance: float = 0.008


def find_obstacles(
    frames: Sequence[RgbdFrame],
    detections: Sequence[Sequence[ObjectDetection]],
    objects: Sequence[ObjectEstimate],
    surface: SupportSurface,
    boxes: Float[np.ndarray, "b 2 3"] = _NO_BOXES,
    config: ObstacleConfig = ObstacleConfig(),
) -> list[PerceivedObstacle]:
    """Return everything on the surface that depth shows beside known objects, the largest first.

    Args:
        frames: Views with poses, without the robot.
        detections: Detections of each frame; those of ``objects`` share their ids.
        objects: Object map.
        surface: Support surface.
        boxes: (b, 2, 3) smallest and largest corners of axis-aligned boxes of known geometry in the world
            frame, in metres.
        config: Parameters.
    """
    views = [clean_frame(frame) for frame in frames]
    known = KnownGeometry.of(objects, boxes)
    points = np.concatenate(
        [np.zeros((0, 3))]
        + [
            unexplained_points(view, found, known, surface, config.explanation)
            for view, found in zip(views, detections, strict=True)
        ]
    )
    T_world_plane = plane_frame(surface.plane)
    T_plane_world = invert(T_world_plane)
    obstacles: list[PerceivedObstacle] = []
    for thing in _clusters(transform_points(T_plane_world, points), config):
        solid = solid_of(thing, views, T_world_plane, config.volume)
        blocked = known.occupies(transform_points(T_world_plane, solid.points), config.clearance)
        solid = replace(solid, points=solid.points[~blocked])
        near = transform_points(T_plane_world, known.surface.data)
        pieces = convex_pieces(solid, near, config.convex)
        if pieces:
            world = tuple(transform_points(T_world_plane, piece) for piece in pieces)
            obstacles.append(PerceivedObstacle(len(obstacles), world, len(thing)))
    return obstacles


def plane_frame(plane: SupportPlane) -> Float[np.ndarray, "4 4"]:
    """Return T_world_plane of a frame with z along the normal and its plane z = 0 on the support."""
    axes = plane_axes(plane)
    return rigid(np.stack([*axes, plane.normal], axis=1), plane.offset * plane.normal)


def _clusters(points: Float[np.ndarray, "n 3"], config: ObstacleConfig) -> list[Float[np.ndarray, "_m 3"]]:
    """Return the points of each thing: connected in plan view, where gaps of a cell are bridged."""
    if not len(points):
        return []
    low = points[:, :2].min(axis=0) - 2 * config.cell
    cells: Int[np.ndarray, "n 2"] = ((points[:, :2] - low) / config.cell).astype(np.int64)
    shape = (int(cells[:, 0].max()) + 3, int(cells[:, 1].max()) + 3)
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    dense = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape) >= config.min_cell_points
    bridged = cv2.dilate(dense.astype(np.uint8), np.ones((3, 3), np.uint8))
    labels = np.asarray(cv2.connectedComponents(bridged, connectivity=8)[1]) * dense
    label = labels.ravel()[flat]
    things = [points[label == k] for k in np.unique(label) if k > 0]
    kept = [
        thing
        for thing in things
        if len(thing) >= config.min_points and np.ptp(thing, axis=0).max() >= config.min_extent
    ]
    return sorted(kept, key=len, reverse=True)
