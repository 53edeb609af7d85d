"""Search for an object of known shape anywhere on its support, in any resting pose.

Depth above the support that no other object explains is grouped into clusters. At each cluster the object is
tried in its resting poses (upright, upside down, on its side along the cluster). The best of each direction,
by the distances between the cluster and the posed surface, is fitted to the depth. A pose is
accepted only if the object explains the cluster and the images show the object: either alone would accept a
piece of something else.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, KDTree

from perception.geometry import pose_from_yaw, transform_points
from perception.inference.observation import pixel_rays
from perception.inference.refit import PoseCheck, RefitConfig, refit_pose
from perception.metrics import SurfaceSamples
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

Region = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class RelocateConfig:
    """Settings of the search.

    Attributes:
        stride: Every ``stride``-th pixel of each image is used.
        min_height: Least height above the support of a point that is not part of it, in metres.
        explained: Distance from another object's surface within which a point belongs to it, in metres.
        cell: Edge length of the cells in which points are grouped, in metres.
        min_points: Least number of points of a cluster.
        near: Distance from the posed surface within which it explains a point, in metres.
        min_coverage: Least share of a cluster's points that the object must explain.
        alike: Difference of inlier shares below which two poses are equally likely.
        n_yaws, n_rolls: Numbers of rotations about the vertical, and about a lying object's axis.
        samples: Number of points on the object's surface.
        refit: Settings of the fit; any orientation is as likely as the candidate's.
    """

    stride: int = 5
    min_height: float = 0.012
    explained: float = 0.012
    cell: float = 0.01
    min_points: int = 40
    near: float = 0.010
    min_coverage: float = 0.8
    alike: float = 0.08
    n_yaws: int = 8
    n_rolls: int = 6
    samples: int = 1500
    refit: RefitConfig = RefitConfig(tilt_sigma=10.0)


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


def relocate(
    estimate: ObjectEstimate,
    scene: SearchScene,
    config: RelocateConfig = RelocateConfig(),
    T_before: Float[np.ndarray, "4 4"] | None = None,
) -> PoseCheck | None:
    """Return the pose of an object on its support; None if no image shows it.

    Args:
        estimate: Object of known shape; its pose is not used.
        scene: Images, and what else explains their depth.
        config: Settings.
        T_before: (4, 4) last known pose. Of poses that the images show equally well, as the two directions of
            a can, the one with its base nearest to where it was is returned: things tip over their base.
    """
    surface = SurfaceSamples.of(estimate.mesh, np.random.default_rng(0), config.samples).points
    points = unexplained_points(scene, config)
    found: list[PoseCheck] = []
    for cluster in clusters(points, config):
        for T in _candidates(surface, cluster, scene.plane, config):
            check = refit_pose(estimate, scene.frames, T, scene.others, scene.plane, config.refit)
            tree = KDTree(transform_points(check.T_world_object, surface))
            coverage = float((tree.query(cluster)[0] < config.near).mean())
            if check.status == "seen" and coverage > config.min_coverage:
                found.append(check)
    if not found:
        return None
    best = max(check.inlier_share for check in found)
    alike = [check for check in found if check.inlier_share > best - config.alike]
    if T_before is None:
        return max(alike, key=lambda check: check.inlier_share)
    base = np.array([0.0, 0.0, estimate.mesh.vertices[:, 2].min()])
    was = transform_points(T_before, base)[:2]
    return min(
        alike,
        key=lambda check: float(np.linalg.norm(transform_points(check.T_world_object, base)[:2] - was)),
    )


def unexplained_points(
    scene: SearchScene, config: RelocateConfig = RelocateConfig()
) -> Float[np.ndarray, "n 3"]:
    """Return the measured points [m] in the region above the support that nothing else there explains."""
    clouds = []
    for frame in scene.frames:
        assert frame.T_world_camera is not None
        camera = frame.intrinsics
        v, u = np.mgrid[0 : camera.height : config.stride, 0 : camera.width : config.stride].reshape(2, -1)
        depth = frame.depth[v, u]
        seen = depth > 0
        points = pixel_rays(frame, u[seen], v[seen]) * depth[seen, None]
        clouds.append(transform_points(frame.T_world_camera, points))
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    (x0, x1), (y0, y1) = scene.region
    inside = (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)
    points = points[inside & (scene.plane.height_above(points) > config.min_height)]
    for other in scene.others:
        samples = SurfaceSamples.of(other.mesh_world, np.random.default_rng(0), 4 * config.samples)
        points = points[samples.tree.query(points)[0] > config.explained] if len(points) else points
    for piece in (piece for obstacle in scene.obstacles for piece in obstacle.pieces):
        faces = np.asarray(ConvexHull(piece).equations)  # outward normals and offsets
        beyond = (points @ faces[:, :3].T + faces[:, 3]).max(axis=1)
        points = points[beyond > config.explained]
    return points


def clusters(
    points: Float[np.ndarray, "n 3"], config: RelocateConfig = RelocateConfig()
) -> list[Float[np.ndarray, "_k 3"]]:
    """Return the groups of points whose cells touch each other in the top view, the largest first."""
    if len(points) == 0:
        return []
    cells = np.floor(points[:, :2] / config.cell).astype(int)
    cells -= cells.min(axis=0)
    occupied = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    occupied[tuple(cells.T)] = True
    count, labels = cv2.connectedComponents(occupied.astype(np.uint8), connectivity=8)
    of_point = labels[tuple(cells.T)]
    groups = [points[of_point == k] for k in range(1, count)]
    return sorted((g for g in groups if len(g) >= config.min_points), key=lambda g: -len(g))


def _candidates(
    surface: Float[np.ndarray, "n 3"],
    cluster: Float[np.ndarray, "k 3"],
    plane: SupportPlane,
    config: RelocateConfig,
) -> list[Float[np.ndarray, "4 4"]]:
    """Return the resting pose nearest to a cluster for each direction of the object's axis."""
    best: dict[tuple[int, ...], tuple[float, Float[np.ndarray, "4 4"]]] = {}
    for T in _resting_poses(surface, cluster, plane, config):
        direction = tuple(np.round(10 * T[:3, 2]).astype(int))
        distance = _distance(T, surface, cluster)
        if direction not in best or distance < best[direction][0]:
            best[direction] = distance, T
    return [T for _, T in best.values()]


def _resting_poses(
    surface: Float[np.ndarray, "n 3"],
    cluster: Float[np.ndarray, "k 3"],
    plane: SupportPlane,
    config: RelocateConfig,
) -> Iterator[Float[np.ndarray, "4 4"]]:
    """Yield the resting poses of a surface with the middle of its top view at that of a cluster."""
    low, high = cluster[:, :2].min(axis=0), cluster[:, :2].max(axis=0)
    centred = cluster[:, :2] - cluster[:, :2].mean(axis=0)
    along = np.linalg.svd(centred, full_matrices=False)[2][0]
    azimuth = float(np.arctan2(along[1], along[0]))
    for R in _orientations(azimuth, config):
        turned = surface @ R.T
        T = np.eye(4)
        T[:3, :3] = R
        T[:2, 3] = (low + high) / 2 - (turned[:, :2].min(axis=0) + turned[:, :2].max(axis=0)) / 2
        support = (plane.offset - plane.normal[:2] @ T[:2, 3]) / plane.normal[2]
        T[2, 3] = support - turned[:, 2].min()
        yield T


def _orientations(azimuth: float, config: RelocateConfig) -> Iterator[Float[np.ndarray, "3 3"]]:
    """Yield rotations: upright and upside down over all yaws, on the side along an azimuth over all rolls."""
    upside_down = np.diag([1.0, -1.0, -1.0])
    for yaw in 2 * np.pi * np.arange(config.n_yaws) / config.n_yaws:
        R = pose_from_yaw(yaw, np.zeros(3))[:3, :3]
        yield R
        yield R @ upside_down
    on_side = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # z of the object along x
    rolls = 2 * np.pi * np.arange(config.n_rolls) / config.n_rolls
    for direction, roll in itertools.product((azimuth, azimuth + np.pi), rolls):
        R = pose_from_yaw(direction, np.zeros(3))[:3, :3] @ on_side
        yield R @ pose_from_yaw(roll, np.zeros(3))[:3, :3]


def _distance(
    T: Float[np.ndarray, "4 4"], surface: Float[np.ndarray, "n 3"], cluster: Float[np.ndarray, "k 3"]
) -> float:
    """Return the mean distance of a cluster's points from the posed surface and its upper half from them [m].

    Both are truncated at 3 cm. The lower half of the surface is rarely seen.
    """
    posed = transform_points(T, surface)
    upper = posed[posed[:, 2] > np.median(posed[:, 2])]
    there = np.minimum(KDTree(posed).query(cluster)[0], 0.03)
    back = np.minimum(KDTree(cluster).query(upper)[0], 0.03)
    return float(there.mean() + back.mean())
