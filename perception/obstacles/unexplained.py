"""Measured points above the support surface that belong to no known object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.detection.geometry import height_image, points_of
from perception.geometry import invert, rigid, transform_points
from perception.inference.contents import VESSELS
from perception.metrics import SurfaceSamples
from perception.obstacles.volume import lowest_height
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

_SAMPLES = 4000  # of an object's surface: about 3 mm apart
_NOWHERE = np.full((1, 3), 1e6)  # a tree needs a point
_DEEPEST = 0.1  # [m] below the surface of an object: what is farther inside is not looked for


@dataclass(frozen=True)
class ExplanationConfig:
    """What explains a measured point; lengths in metres.

    Attributes:
        max_height: Largest height above the surface.
        beyond: Distance outside the outline of the surface up to which things stand on it.
        margin: Distance from a known object within which points are measurements of it.
        mask_margin: The same for points in the object's detection mask. A mask that extends over a neighbour
            does not hide it.
    """

    max_height: float = 0.4
    beyond: float = 0.02
    margin: float = 0.015
    mask_margin: float = 0.04


@dataclass(frozen=True)
class Cavity:
    """The cylinder between the foot of an upright vessel and its rim.

    Attributes:
        T_cavity_world: Transform to a frame with its z along the axis and its origin in the middle.
        radius: Radius in metres.
        half_height: Half its height in metres.
    """

    T_cavity_world: Float[np.ndarray, "4 4"]
    radius: float
    half_height: float

    @staticmethod
    def of(vessel: ObjectEstimate) -> Cavity:
        """Return the cavity of a mug or bowl."""
        low, high = vessel.mesh.vertices.min(axis=0), vessel.mesh.vertices.max(axis=0)
        radius = (high[1] - low[1]) / 2
        middle = np.array(
            [low[0] + radius, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2]
        )  # handle along +x
        T_world_cavity = vessel.T_world_object @ rigid(np.eye(3), middle)
        return Cavity(invert(T_world_cavity), float(radius), float(high[2] - low[2]) / 2)

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which world points [m] it contains."""
        local = transform_points(self.T_cavity_world, points)
        return (np.hypot(local[:, 0], local[:, 1]) < self.radius) & (np.abs(local[:, 2]) < self.half_height)


@dataclass(frozen=True)
class KnownGeometry:
    """Objects of the object map and boxes of known geometry.

    What lies in an upright vessel below its rim belongs to the vessel: it is moved together with it.

    Attributes:
        surface: Points on the objects' surfaces in the world frame, in metres.
        normals: (n, 3) outward normals at these points.
        samples: Points on the surface of each object, by id.
        boxes: (b, 2, 3) smallest and largest corners of axis-aligned boxes in the world frame.
        cavities: Cavities of the upright vessels.
    """

    surface: KDTree
    normals: Float[np.ndarray, "n 3"]
    samples: Mapping[int, SurfaceSamples]
    boxes: Float[np.ndarray, "b 2 3"] = field(default_factory=lambda: np.zeros((0, 2, 3)))
    cavities: Sequence[Cavity] = ()

    @staticmethod
    def of(
        objects: Sequence[ObjectEstimate], boxes: Float[np.ndarray, "b 2 3"] = np.zeros((0, 2, 3))
    ) -> KnownGeometry:
        """Return the geometry of object estimates and boxes."""
        rng = np.random.default_rng(0)
        samples = {e.id: SurfaceSamples.of(e.mesh_world, rng, _SAMPLES) for e in objects}
        points = np.concatenate([_NOWHERE, *(sample.points for sample in samples.values())])
        normals = np.concatenate([np.zeros((1, 3)), *(sample.normals for sample in samples.values())])
        vessels = (e for e in objects if e.category in VESSELS and e.resting == "upright")
        return KnownGeometry(KDTree(points), normals, samples, boxes, [Cavity.of(e) for e in vessels])

    def explains(self, points: Float[np.ndarray, "n 3"], margin: float) -> Bool[np.ndarray, "n"]:
        """Return which points lie within ``margin`` metres of an object or a box, or in a vessel."""
        distance = self.surface.query(points, distance_upper_bound=margin)[0]
        explained = (distance < margin) | _in_boxes(points, self.boxes, margin)
        for cavity in self.cavities:
            explained |= cavity.contains(points)
        return explained

    def occupies(self, points: Float[np.ndarray, "n 3"], margin: float) -> Bool[np.ndarray, "n"]:
        """Return which points lie inside an object or a box, or within ``margin`` metres of one."""
        distance, nearest = self.surface.query(points, distance_upper_bound=_DEEPEST)
        near = distance < _DEEPEST
        nearest = np.where(near, nearest, 0)
        outwards = ((points - self.surface.data[nearest]) * self.normals[nearest]).sum(axis=1)
        return near & ((distance < margin) | (outwards < 0)) | _in_boxes(points, self.boxes, margin)


def unexplained_points(
    frame: RgbdFrame,
    detections: Sequence[ObjectDetection],
    known: KnownGeometry,
    surface: SupportSurface,
    config: ExplanationConfig = ExplanationConfig(),
) -> Float[np.ndarray, "n 3"]:
    """Return the world points [m] above the surface that are measurements of no known object.

    Args:
        frame: View without flying pixels (``clean_depth``) and without the robot.
        detections: Detections in the frame; the masks of known objects are theirs but for outliers.
        known: Known geometry.
        surface: Support surface.
        config: Parameters.
    """
    raised = raised_pixels(frame, surface.plane, config.max_height)
    if not raised.any():
        return np.zeros((0, 3))
    points = points_of(frame, raised)
    free = surface.beyond(points) < config.beyond
    for found in detections:
        own = known.samples.get(-1 if found.instance_id is None else found.instance_id)
        if own is not None:
            masked = found.mask[raised]
            free[masked] &= own.distance(points[masked], config.mask_margin) >= config.mask_margin
    points = points[free]
    return points[~known.explains(points, config.margin)]


def raised_pixels(
    frame: RgbdFrame, plane: SupportPlane, max_height: float = np.inf
) -> Bool[np.ndarray, "h w"]:
    """Return the measured pixels above a plane, by more than noise and less than ``max_height`` [m]."""
    height = height_image(frame, plane)
    return (frame.depth > 0) & (height > lowest_height(frame.depth)) & (height < max_height)


def _in_boxes(
    points: Float[np.ndarray, "n 3"], boxes: Float[np.ndarray, "b 2 3"], margin: float
) -> Bool[np.ndarray, "n"]:
    inside = np.zeros(len(points), dtype=bool)
    for low, high in boxes:
        inside |= ((points > low - margin) & (points < high + margin)).all(axis=1)
    return inside
