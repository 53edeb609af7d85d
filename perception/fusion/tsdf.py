"""TSDF fusion of single objects, the baseline without a shape prior (needs open3d, extra ``eval``).

The depth of each object is fused into a truncated signed distance function (Curless and Levoy, 1996), as in
Fusion++ (McCormac et al., 2018). Unobserved surfaces are missing (``closed=False``, for comparing surfaces)
or closed without a shape prior for planning (``closed=True``): unobserved space within the horizontal
outline of the object's points and below their top counts as solid.
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
from perception.geometry import pose_from_yaw
from perception.types import (
    CODE_SIZE,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
)

logger = logging.getLogger(__name__)


_MIN_HEIGHT = 0.003  # [m]; points lower above the support plane count as the plane


class FusionUnavailableError(PerceptionError):
    """open3d is missing or does not load; the message names the packages to install."""


@dataclass(frozen=True)
class TsdfConfig:
    """Parameters of TSDF fusion.

    Attributes:
        voxel: Edge length of a voxel in [m].
        truncation: Truncation distance of the signed distance in [m].
        margin: Margin of the volume around the object's points in [m].
        max_extent: Diameter around the median of an object's points in [m]; points outside are mask errors.
        min_points: Minimum number of depth points of an object.
        closed: Whether to close the mesh where the surface is unobserved.
    """

    voxel: float = 0.002
    truncation: float = 0.008
    margin: float = 0.02
    max_extent: float = 0.6
    min_points: int = 200
    closed: bool = True


def reconstruct_tsdf(
    frames: Sequence[RgbdFrame],
    detections: Sequence[Sequence[ObjectDetection]],
    plane: SupportPlane,
    config: TsdfConfig = TsdfConfig(),
) -> list[ObjectEstimate]:
    """Fuse each instance with enough depth points; codes are zero, and the yaw is zero except for mugs.

    Args:
        frames: Frames; those without a camera pose are ignored.
        detections: Detections of each frame; those without ``instance_id`` are ignored.
        plane: Support plane of the objects.
        config: Parameters of the fusion.

    Raises:
        FusionUnavailableError: open3d is missing or does not load.
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
            logger.warning("%s %d has too little depth to fuse", views[0][1].category, instance_id)
        else:
            estimates.append(estimate)
    return estimates


def load_open3d() -> Any:
    """Import open3d, an optional dependency.

    Raises:
        FusionUnavailableError: open3d is missing or does not load.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:  # OSError: libusb is missing
        raise FusionUnavailableError(
            f"TSDF fusion needs open3d ({error}): {install_hint('eval')}, apt-get install libusb-1.0-0"
        ) from None
    return open3d


def masked_cloud(frame: RgbdFrame, mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 3"]:
    """Return the world points of the mask's pixels with a depth measurement, in [m]."""
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
    points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < config.max_extent / 2]
    points = points[plane.height_above(points) > _MIN_HEIGHT]
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
    for frame, found in views:  # depth of the background carves free space beside the object
        _integrate(open3d, volume, frame if config.closed else _masked(frame, found.mask))
    if not config.closed:
        mesh = _open_surface(volume, plane)
        return None if mesh is None else _estimate(instance_id, mesh, views)
    values = np.asarray(volume.extract_volume_tsdf()).reshape((resolution,) * 3 + (2,))
    mesh = _closed_surface(values, corner, side / resolution, points, plane)
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
    """Return the frame without measurements outside the mask."""
    return replace(frame, depth=np.where(mask, frame.depth, 0).astype(np.float32))


def _open_surface(volume: Any, plane: SupportPlane) -> TriangleMesh | None:
    """Return the observed surface, without faces of the support plane included by oversized masks."""
    mesh = volume.extract_triangle_mesh()
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    above = plane.height_above(vertices) > _MIN_HEIGHT if len(vertices) else np.zeros(0, bool)
    kept = faces[above[faces].all(axis=1)] if len(faces) else faces
    used, index = np.unique(kept, return_inverse=True)
    return TriangleMesh(vertices[used], index.reshape(-1, 3)) if len(kept) else None


def _closed_surface(
    values: Float[np.ndarray, "r r r 2"],
    corner: Float[np.ndarray, "3"],
    voxel: float,
    points: Float[np.ndarray, "n 3"],
    plane: SupportPlane,
) -> TriangleMesh | None:
    """Return the closed zero level set of the largest connected solid.

    Unobserved voxels (weight 0) are solid if they lie inside the horizontal convex hull of the points and
    below their top, and free otherwise.

    Args:
        values: Truncated signed distance, in units of the truncation distance, and weight of each voxel.
        corner: World position of the volume's lower corner in [m].
        voxel: Edge length of a voxel in [m].
        points: World points of the object in [m].
        plane: Support plane.
    """
    distance, observed = values[..., 0].copy(), values[..., 1] > 0
    centres = corner + voxel * (np.moveaxis(np.indices(distance.shape), 0, -1) + 0.5)
    outline = Delaunay(points[:: max(1, len(points) // 2000), :2])
    covered = outline.find_simplex(centres[:, :, 0, :2]) >= 0
    inside = covered[..., None] & (centres[..., 2] <= np.percentile(points[:, 2], 99.5))
    distance[~observed] = np.where(inside[~observed], -1.0, 1.0)
    near = np.asarray(ndimage.binary_dilation(inside, iterations=3), dtype=bool)
    distance[~near | (plane.height_above(centres) < 0)] = 1.0  # other objects, and the support
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
    """Return the estimate with an upright frame at the centre of the mesh's bounding box.

    The yaw is that of the most probable bin of the first view.
    """
    detection = views[0][1]
    bins = detection.yaw_probabilities
    yaw = 2 * np.pi * int(np.argmax(bins)) / len(bins) if len(bins) else 0.0
    T = pose_from_yaw(yaw, np.zeros(3))
    vertices = mesh_world.vertices @ T[:3, :3]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    T[:3, 3] = T[:3, :3] @ ((low + high) / 2)
    return ObjectEstimate(
        id=instance_id,
        category=detection.category,
        code=np.zeros(CODE_SIZE),
        T_world_object=T,
        scale=np.full(3, float((high - low).max()) / 1.8),
        mesh=TriangleMesh(vertices - (low + high) / 2, mesh_world.faces),
        score=detection.score,
        n_views=len(views),
    )
