"""Votes of depth images on poses of a known shape, without rendering: fast enough for thousands of poses.

Points on the surface are projected into the images. A point that its camera would see votes for the pose if
depth of no other object is measured there, against it if depth is measured behind it, and counts as covered
if such depth is measured in front of it. Which points a camera sees of an object that stands alone is
tabulated once for all directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import minimum_filter

from perception.geometry import invert, transform_points
from perception.inference.observation import pixel_rays
from perception.metrics import SurfaceSamples
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, SupportPlane, TriangleMesh

Region = tuple[tuple[float, float], tuple[float, float]]

SAMPLES_OF_OTHERS = 6000  # on the surface of each object that explains depth
_DIRECTIONS = 150  # of view that are tabulated
_DENSE = 6000  # points on the surface that hide others
_CELL = 0.005  # [m] of the grid in which they do
_BEHIND = 0.012  # [m] beyond the nearest of them from which on a point is hidden
_GRAZING = 0.3  # least cosine between the normal and the direction to the camera
_MISSING = 0.05  # votes that a pose lacks, as a share of half of its points in each image


@dataclass(frozen=True)
class SearchScene:
    """What is searched, and what is known of it.

    Attributes:
        frames: Views of the support with camera poses.
        region: Ranges of x and y to search, in metres.
        others: Objects at their present poses, which explain depth.
        obstacles: Things of no class, which explain depth.
        plane: Support plane.
    """

    frames: Sequence[RgbdFrame]
    region: Region
    others: Sequence[ObjectEstimate] = ()
    obstacles: Sequence[PerceivedObstacle] = ()
    plane: SupportPlane = SupportPlane()


class VisibleSamples:
    """Points on a surface, with a table of those that are seen from each direction.

    Args:
        mesh: The surface in the object frame, in metres.
        count: Number of points.
    """

    def __init__(self, mesh: TriangleMesh, count: int) -> None:
        samples = SurfaceSamples.of(mesh, np.random.default_rng(0), count)
        dense = SurfaceSamples.of(mesh, np.random.default_rng(1), _DENSE).points
        self.points: Float[np.ndarray, "m 3"] = samples.points.astype(np.float32)
        self._directions = _spread_directions(_DIRECTIONS)
        self._seen = np.stack([_seen_from(w, samples, dense) for w in self._directions])

    def seen_from(self, toward_camera: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, "k m"]:
        """Return which points are seen from directions in the object frame, of any length."""
        return self._seen[np.argmax(toward_camera @ self._directions.T, axis=1)]


@dataclass(frozen=True)
class DepthVotes:
    """Depth images in which what other objects explain is marked. Create it with ``of``.

    Attributes:
        views: The images.
        points: (n, 3) measured points in the world frame that nothing else explains, in metres.
    """

    views: tuple[View, ...]
    points: Float[np.ndarray, "n 3"]

    @staticmethod
    def of(scene: SearchScene, stride: int, min_height: float, explained: float) -> DepthVotes:
        """Return the depth images of a scene.

        Args:
            scene: Images, and what is known.
            stride: Every ``stride``-th pixel is used.
            min_height: Least height above the support of a point that is not part of it, in metres.
            explained: Distance from another object within which a point belongs to it, in metres.
        """
        views: list[View] = []
        clouds = [np.zeros((0, 3))]
        for frame in scene.frames:
            assert frame.T_world_camera is not None
            v, u = np.mgrid[0 : frame.intrinsics.height : stride, 0 : frame.intrinsics.width : stride]
            depth = frame.depth[v, u]
            measured = depth > 0
            rays = pixel_rays(frame, u[measured], v[measured])
            points = transform_points(frame.T_world_camera, rays * depth[measured, None])
            unexplained = _unexplained(points, scene, min_height, explained)
            own = np.zeros(depth.shape, dtype=bool)
            own[measured] = unexplained
            clouds.append(points[unexplained])
            views.append(View(depth, own, frame.T_world_camera, frame.intrinsics, stride))
        return DepthVotes(tuple(views), np.concatenate(clouds))

    def widened(self, distance: float) -> DepthVotes:
        """Return the votes of images in which what is unexplained is wider by a distance [m] on all sides.

        A pose beside the right one by less has fewer points against it.
        """
        return replace(self, views=tuple(view.widened(distance) for view in self.views))

    def score(
        self,
        samples: VisibleSamples,
        rotation: Float[np.ndarray, "3 3"],
        positions: Float[np.ndarray, "k 3"],
        near: float,
    ) -> Float[np.ndarray, "k"]:
        """Return how well the images agree with an object at each of several positions, in -1..1.

        Points for it less those against it, as a share of both and of those that something unexplained
        covers. Those that another object hides, or that no image shows, do not count.

        Args:
            samples: Points on the object.
            rotation: R_world_object.
            positions: t_world_object, in metres.
            near: Largest distance between a point and the depth that is measured there, in metres.
        """
        turned = samples.points @ rotation.T.astype(np.float32)
        posed = turned + positions[:, None].astype(np.float32)
        counts = np.zeros((3, len(positions)), int)
        for view in self.views:
            seen = samples.seen_from((view.T_world_camera[:3, 3] - positions) @ rotation)
            counts += view.votes(posed, seen, near)
        agree, through, covered = counts
        missing = 0.5 * _MISSING * len(samples.points) * len(self.views)
        return (agree - through) / (agree + through + covered + missing)


@dataclass(frozen=True)
class View:
    """Every ``stride``-th pixel of a depth image.

    Attributes:
        depth: Measured depth in metres; 0 where it is missing.
        own: Pixels that nothing else explains.
        T_world_camera: Pose of the camera.
        camera: Intrinsics of the full image.
        stride: Distance between the pixels in the full image.
    """

    depth: Float[np.ndarray, "h w"]
    own: Bool[np.ndarray, "h w"]
    T_world_camera: Float[np.ndarray, "4 4"]
    camera: CameraIntrinsics
    stride: int

    def widened(self, distance: float) -> View:
        """Return the view with the own pixels spread over their surroundings, the nearest depth first."""
        if not self.own.any():
            return self
        depth = np.where(self.own, self.depth, np.inf)
        pixels = distance * self.camera.fx / (self.stride * float(np.median(depth[self.own])))
        spread = minimum_filter(depth, 2 * round(pixels) + 1)
        own = np.isfinite(spread)
        return replace(self, depth=np.where(self.own | ~own, self.depth, spread), own=own)

    def votes(
        self, points: Float[np.ndarray, "k m 3"], seen: Bool[np.ndarray, "k m"], near: float
    ) -> Int[np.ndarray, "3 k"]:
        """Return the numbers of points for a pose, against it, and covered."""
        T = invert(self.T_world_camera).astype(np.float32)
        x, y, z = np.moveaxis(points @ T[:3, :3].T + T[:3, 3], -1, 0)
        ahead = np.maximum(z, 1e-3)
        u = np.rint((self.camera.fx * x / ahead + self.camera.cx) / self.stride).astype(int)
        v = np.rint((self.camera.fy * y / ahead + self.camera.cy) / self.stride).astype(int)
        height, width = self.depth.shape
        counts = seen & (z > 1e-3) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        u, v = np.where(counts, u, 0), np.where(counts, v, 0)
        depth, own = self.depth[v, u], self.own[v, u]
        counts &= depth > 0
        agree = counts & own & (np.abs(z - depth) < near)
        through = counts & (depth > z + near)
        covered = counts & own & (depth < z - near)
        return np.stack([agree.sum(axis=1), through.sum(axis=1), covered.sum(axis=1)])


def _unexplained(
    points: Float[np.ndarray, "n 3"], scene: SearchScene, min_height: float, explained: float
) -> Bool[np.ndarray, "n"]:
    """Return which points lie in the region above the support, and on nothing that is known."""
    (x0, x1), (y0, y1) = scene.region
    inside = (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)
    left = np.flatnonzero(inside & (scene.plane.height_above(points) > min_height))
    for other in scene.others:
        samples = SurfaceSamples.of(other.mesh_world, np.random.default_rng(0), SAMPLES_OF_OTHERS)
        left = left[samples.distance(points[left]) > explained]
    for obstacle in scene.obstacles:
        left = left[~obstacle.explains(points[left], explained)]
    mask = np.zeros(len(points), dtype=bool)
    mask[left] = True
    return mask


def _spread_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors spread over the sphere along a spiral (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def _seen_from(
    direction: Float[np.ndarray, "3"], samples: SurfaceSamples, dense: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "m"]:
    """Return which samples face a direction and are not hidden by dense points of the same surface."""
    least = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(direction, least) / np.linalg.norm(np.cross(direction, least))
    plane = np.stack([x, np.cross(direction, x)], axis=1)
    low = (dense @ plane).min(axis=0)
    size = np.floor(((dense @ plane).max(axis=0) - low) / _CELL).astype(int) + 1

    def cells(points: Float[np.ndarray, "k 3"]) -> tuple[np.ndarray, ...]:
        return tuple(np.clip(((points @ plane - low) / _CELL).astype(int), 0, size - 1).T)

    nearest = np.full(size, -np.inf)
    np.maximum.at(nearest, cells(dense), dense @ direction)
    is_open = samples.points @ direction > nearest[cells(samples.points)] - _BEHIND
    return is_open & (samples.normals @ direction > _GRAZING)
