"""TSDF fusion of single objects, the baseline without a shape prior (extra ``eval``: open3d).

Each object's masked depth is fused into a truncated signed distance volume (Curless and Levoy, 1996), as the
Fusion++ line of systems does. What no camera saw has no surface; so that a planner can use the mesh it is
closed as well as that goes without knowing shapes: unseen space above the points' outline counts as solid.
For a comparison of surfaces the plain, open one is taken (``closed=False``).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import Delaunay
from skimage.measure import label, marching_cubes

from perception.errors import PerceptionError, install_hint
from perception.types import (
    CODE_SIZE,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
)

_log = logging.getLogger(__name__)


class FusionUnavailableError(PerceptionError):
    """open3d is missing or does not load; the message says what to install."""


@dataclass(frozen=True)
class TsdfConfig:
    """Settings of the volume.

    Attributes:
        voxel: edge of a voxel in [m].
        truncation: distance at which the signed distance is cut off in [m].
        margin: free space around the object's cloud in [m].
        largest: extent of an object [m]; what a mask too wide shows farther away is left out.
        min_points: depth points that an object needs.
        closed: whether what no camera saw is made up, so that the mesh is closed.
    """

    voxel: float = 0.002
    truncation: float = 0.008
    margin: float = 0.02
    largest: float = 0.6
    min_points: int = 200
    closed: bool = True


def reconstruct_tsdf(
    frames: Sequence[RgbdFrame],
    detections: Sequence[Sequence[ObjectDetection]],
    plane: SupportPlane,
    config: TsdfConfig = TsdfConfig(),
) -> list[ObjectEstimate]:
    """One estimate for each instance with enough depth; codes are zero, yaw is 0 but for mugs.

    Args:
        frames: posed frames.
        detections: for each frame its detections with ``instance_id``.
        plane: what the objects stand on.

    Raises:
        FusionUnavailableError: open3d is not installed.
    """
    open3d = load_open3d()
    instances: dict[int, list[tuple[RgbdFrame, ObjectDetection]]] = {}
    for frame, found in zip(frames, detections, strict=True):
        for detection in found:
            if detection.instance_id is not None and frame.T_world_camera is not None:
                instances.setdefault(detection.instance_id, []).append((frame, detection))
    estimates = []
    for instance_id, views in sorted(instances.items()):
        estimate = _fuse(open3d, instance_id, views, plane, config)
        if estimate is None:
            _log.warning("%s %d has too little depth to fuse", views[0][1].category, instance_id)
        else:
            estimates.append(estimate)
    return estimates


def load_open3d() -> Any:
    """The open3d module, imported only here.

    Raises:
        FusionUnavailableError: with what to install.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:  # OSError: its libusb is missing
        raise FusionUnavailableError(
            f"TSDF fusion needs open3d ({error}): {install_hint('eval')}, apt-get install libusb-1.0-0"
        ) from None
    return open3d


def masked_cloud(frame: RgbdFrame, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 3"]:
    """World points of the mask's measured pixels."""
    assert frame.T_world_camera is not None
    v, u = np.nonzero(mask & (frame.depth > 0))
    z = frame.depth[v, u].astype(np.float64)
    camera = frame.intrinsics
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
    return points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]


def _fuse(
    open3d: Any,
    instance_id: int,
    views: list[tuple[RgbdFrame, ObjectDetection]],
    plane: SupportPlane,
    config: TsdfConfig,
) -> ObjectEstimate | None:
    points = np.concatenate([masked_cloud(frame, found.mask) for frame, found in views])
    if not len(points):
        return None
    points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < config.largest / 2]
    points = points[plane.height_above(points) > 0.003]
    if len(points) < config.min_points:
        return None
    low, high = np.percentile(points, (0.5, 99.5), axis=0)
    low[2] = plane.offset
    corner, side = low - config.margin, float((high - low).max() + 2 * config.margin)
    resolution = int(np.ceil(side / config.voxel))
    volume = open3d.pipelines.integration.UniformTSDFVolume(
        length=side,
        resolution=resolution,
        sdf_trunc=config.truncation,
        color_type=open3d.pipelines.integration.TSDFVolumeColorType.RGB8,
        origin=corner.reshape(3, 1),
    )
    for frame, found in views:  # whole images: what is seen behind the object carves the space beside it
        _integrate(open3d, volume, frame if config.closed else _masked(frame, found.mask))
    if not config.closed:
        seen = _open(volume, plane)
        return None if seen is None else _estimate(instance_id, seen, views)
    values = np.asarray(volume.extract_volume_tsdf()).reshape((resolution,) * 3 + (2,))
    mesh = _closed(values, corner, side / resolution, points, plane)
    return None if mesh is None else _estimate(instance_id, mesh, views)


def _integrate(open3d: Any, volume: Any, frame: RgbdFrame) -> None:
    camera = frame.intrinsics
    image = open3d.geometry.RGBDImage.create_from_color_and_depth(
        open3d.geometry.Image(np.ascontiguousarray(frame.rgb)),
        open3d.geometry.Image(np.ascontiguousarray(frame.depth)),
        depth_scale=1.0,
        depth_trunc=10.0,
        convert_rgb_to_intensity=False,
    )
    pinhole = open3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    )
    volume.integrate(image, pinhole, np.linalg.inv(np.asarray(frame.T_world_camera)))


def _masked(frame: RgbdFrame, mask: Bool[np.ndarray, "h w"]) -> RgbdFrame:
    """The frame with nothing measured outside the mask."""
    return replace(frame, depth=np.where(mask, frame.depth, 0).astype(np.float32))


def _open(volume: Any, plane: SupportPlane) -> TriangleMesh | None:
    """The surface where it was seen, without what masks too wide brought in of the table."""
    mesh = volume.extract_triangle_mesh()
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    above = plane.height_above(vertices) > 0.003 if len(vertices) else np.zeros(0, bool)
    kept = faces[above[faces].all(axis=1)] if len(faces) else faces
    used, index = np.unique(kept, return_inverse=True)
    return TriangleMesh(vertices[used], index.reshape(-1, 3)) if len(kept) else None


def _closed(
    values: Float[np.ndarray, "r r r 2"],
    corner: Float[np.ndarray, "3"],
    voxel: float,
    points: Float[np.ndarray, "n 3"],
    plane: SupportPlane,
) -> TriangleMesh | None:
    """The zero level, closed: what no camera saw is solid between the outline of the points and their top."""
    distance, seen = values[..., 0].copy(), values[..., 1] > 0
    centres = corner + voxel * (np.moveaxis(np.indices(distance.shape), 0, -1) + 0.5)
    outline = Delaunay(points[:: max(1, len(points) // 2000), :2])
    covered = outline.find_simplex(centres[:, :, 0, :2]) >= 0
    inside = covered[..., None] & (centres[..., 2] <= np.percentile(points[:, 2], 99.5))
    distance[~seen] = np.where(inside[~seen], -1.0, 1.0)
    near = np.asarray(ndimage.binary_dilation(inside, iterations=3), dtype=bool)
    distance[~near | (plane.height_above(centres) < 0)] = 1.0  # neighbours, and the table itself
    labels: np.ndarray = np.asarray(label(distance < 0, connectivity=1))
    count = int(labels.max())
    if count == 0:
        return None
    largest = 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    distance[(labels != largest) & (distance < 0)] = 1.0
    vertices, faces = marching_cubes(np.pad(distance, 1, constant_values=1.0), 0.0)[:2]
    return TriangleMesh(corner + voxel * (vertices - 0.5), faces)


def _estimate(
    instance_id: int, mesh_world: TriangleMesh, views: list[tuple[RgbdFrame, ObjectDetection]]
) -> ObjectEstimate:
    """The mesh in an upright frame at the middle of its bounding box; a mug's yaw is what its views say."""
    detection = views[0][1]
    bins = detection.yaw_probabilities
    yaw = 2 * np.pi * int(np.argmax(bins)) / len(bins) if len(bins) else 0.0
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    turned = mesh_world.vertices @ T[:3, :3]
    low, high = turned.min(axis=0), turned.max(axis=0)
    T[:3, 3] = T[:3, :3] @ ((low + high) / 2)
    return ObjectEstimate(
        id=instance_id,
        category=detection.category,
        code=np.zeros(CODE_SIZE),
        T_world_object=T,
        scale=np.full(3, float((high - low).max()) / 1.8),
        mesh=TriangleMesh(turned - (low + high) / 2, mesh_world.faces),
        score=detection.score,
        n_views=len(views),
    )
