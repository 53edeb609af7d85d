"""Refinement of a fitted mesh on the measured depth.

Code and pose are 25 parameters for a whole object; the measured depth determines the visible surface more
precisely. Every vertex is displaced along its normal by d. Where a view shows the vertex, the measured
displacement is

    d_v = r_v (n_v . b_v),    r_v measured minus predicted depth, b_v ray (z = 1), n_v normal of the vertex,

with a Gaussian prior on d: smooth over the surface, small where nothing is measured, and with components that
many vertices share. One is common to all (a surface too large or too small). The others are sections that are
not round, which the shape prior does not have: harmonics cos(m phi) and sin(m phi) of the radius in the
azimuth phi about the object's axis, of the orders of regular polygons. The MAP estimate solves a sparse
linear system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import cg

from perception.geometry import invert, transform_points
from perception.inference.observation import ObjectObservation, pixel_rays
from perception.surface_geometry import mesh_edges, vertex_normals
from perception.types import RgbdFrame, SupportPlane, TriangleMesh

_MARGIN = 24  # [px] border of the image window around the mesh


@dataclass(frozen=True)
class RefineConfig:
    """Standard deviations and limits of the refinement.

    Attributes:
        depth_sigma: Standard deviation of one depth measurement, in metres.
        floor_sigma: Standard deviation that averaging the measurements of a vertex cannot reduce, in metres.
        prior_sigma: Prior standard deviation of a vertex's own displacement, in metres.
        common_sigma: Prior standard deviation of the displacement common to all vertices, in metres.
        section_sigma: Prior standard deviation of the amplitude of each harmonic of the section, in metres.
        sections: Orders of these harmonics.
        roughness: Prior standard deviation of the difference of displacements over a mesh edge, per length.
        reach: Largest distance of a measurement from the vertex along the ray, in metres.
        steepest: Smallest cosine between ray and normal of a measured vertex.
        edge: Width of the border of the mask that is not used, in pixels.
        outline_sigma: Standard deviation of the outline in a view, in metres.
        support_sigma: Standard deviation of the height of the bottom above the support plane, in metres.
        limit: Largest displacement, in metres.
        passes: Number of data associations, each at the vertices moved by the previous one.
        smoothing: Passes of the low-pass filter that removes the voxel staircase before the refinement.
    """

    depth_sigma: float = 0.002
    floor_sigma: float = 0.0005
    prior_sigma: float = 0.003
    common_sigma: float = 0.002
    section_sigma: float = 0.002
    sections: tuple[int, ...] = (4, 5, 6, 8, 12, 16)
    roughness: float = 0.35
    reach: float = 0.012
    steepest: float = 0.25
    edge: int = 3
    outline_sigma: float = 0.001
    support_sigma: float = 0.0007
    limit: float = 0.010
    passes: int = 2
    smoothing: int = 5


@dataclass(frozen=True)
class RefinedMesh:
    """Result of a refinement.

    Attributes:
        mesh: Mesh with displaced vertices and unchanged faces.
        determined: Weight of the measurements in the estimate of each vertex, in 0..1; the rest is prior.
    """

    mesh: TriangleMesh
    determined: Float[np.ndarray, "n"]


def refine_mesh(
    mesh_world: TriangleMesh,
    observations: Sequence[ObjectObservation],
    plane: SupportPlane,
    config: RefineConfig = RefineConfig(),
    T_world_object: Float[np.ndarray, "4 4"] | None = None,
) -> RefinedMesh:
    """Displace the vertices of a mesh onto the measured depth.

    Args:
        mesh_world: Closed mesh in the world frame, in metres.
        observations: Views of the object.
        plane: Support plane, which the refined mesh does not penetrate.
        config: Standard deviations and limits.
        T_world_object: Pose of an object whose sections about its z axis need not be round; None for others.
    """
    start = _smoothed(mesh_world, config.smoothing)
    normals = vertex_normals(TriangleMesh(start, mesh_world.faces))
    edges = mesh_edges(mesh_world.faces)
    edge_length = float(np.median(np.linalg.norm(start[edges[:, 0]] - start[edges[:, 1]], axis=1)))
    links = _links(edges, len(start)) * (config.roughness * edge_length) ** -2
    shared, sigmas = np.ones((len(normals), 1)), np.array([config.common_sigma])
    if T_world_object is not None and config.sections:
        harmonics = _section_harmonics(start, normals, T_world_object, config.sections)
        shared = np.column_stack([shared, harmonics])
        sigmas = np.append(sigmas, np.full(harmonics.shape[1], config.section_sigma))
    d, precision = np.zeros(len(normals)), np.zeros(len(normals))
    moved = start
    for _ in range(config.passes):  # a displaced vertex projects to another pixel
        precision, information = _measurements(edge_length, moved, normals, observations, plane, config)
        d = _map_displacement(links, precision, precision * d + information, shared, sigmas, config)
        moved = start + d[:, None] * normals
    # The estimate is linear in the measured displacements: its response to 1 everywhere is their weight.
    determined = np.clip(_solved(_posterior_precision(links, precision, config), precision), 0.0, 1.0)
    moved = moved - np.minimum(plane.height_above(moved), 0.0)[:, None] * plane.normal
    return RefinedMesh(TriangleMesh(moved, mesh_world.faces), determined)


def _smoothed(mesh: TriangleMesh, passes: int) -> Float[np.ndarray, "n 3"]:
    """Return the vertices after a low-pass filter without shrinkage (Taubin, SIGGRAPH 1995)."""
    vertices = mesh.vertices
    links = _links(mesh_edges(mesh.faces), len(vertices))
    mean = sparse.diags_array(1 / links.sum(axis=1)) @ links
    for factor in (0.5, -0.53) * passes:
        vertices = vertices + factor * (mean @ vertices - vertices)
    return vertices


def _links(edges: Int[np.ndarray, "e 2"], n: int) -> sparse.csr_array:
    """Return the adjacency matrix of ``n`` vertices: 1 for every two that share an edge."""
    i, j = edges.T
    return sparse.coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n, n)).tocsr()


def _measurements(
    edge_length: float,
    vertices: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    observations: Sequence[ObjectObservation],
    plane: SupportPlane,
    config: RefineConfig,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return precision, in 1/m², and precision times measured displacement, in 1/m, of each vertex.

    Displacements are relative to ``vertices``; depth, outlines and the support plane contribute.
    """
    height = plane.height_above(vertices)
    lowest = (normals @ plane.normal < -0.7) & (height < height.min() + 0.002)
    precision = lowest / config.support_sigma**2
    information = precision * height  # along the normal, which points down
    for seen in observations:
        view = _View.of(edge_length, vertices, normals, seen)
        for w, d in (
            _depth_displacement(view, seen, config),
            _outline_displacement(view, seen, plane, config),
        ):
            precision = precision + w
            information = information + w * d
    return precision, information


@dataclass(frozen=True)
class _View:
    """Vertices projected to one image, cropped to a window around them.

    Attributes:
        window: Rows and columns of the image.
        at: Row and column of each vertex in the window; (0, 0) outside the image.
        inside: Whether each vertex projects into the image.
        z: Depth of each vertex, in metres.
        cosine: Product of the normal of each vertex and its ray (z = 1), negative towards the camera.
        across: (n, 2) components of each normal along the image's x and y axes.
        spacing: Median projected edge length of the mesh, in pixels.
    """

    window: tuple[slice, slice]
    at: tuple[np.ndarray, np.ndarray]
    inside: np.ndarray
    z: np.ndarray
    cosine: np.ndarray
    across: np.ndarray
    spacing: float

    @staticmethod
    def of(edge_length: float, vertices: np.ndarray, normals: np.ndarray, seen: ObjectObservation) -> _View:
        camera, T_camera_world = seen.frame.intrinsics, invert(seen.T_world_camera)
        points = transform_points(T_camera_world, vertices)
        z = np.maximum(points[:, 2], 1e-3)
        rays = points / z[:, None]
        u = np.rint(camera.fx * rays[:, 0] + camera.cx).astype(int)
        v = np.rint(camera.fy * rays[:, 1] + camera.cy).astype(int)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (points[:, 2] > 0.01)
        turned = normals @ T_camera_world[:3, :3].T
        spacing = edge_length * camera.fx / float(np.median(z))
        rows, columns = (
            _around(index[inside], size) for index, size in ((v, camera.height), (u, camera.width))
        )
        at = (np.where(inside, v - rows.start, 0), np.where(inside, u - columns.start, 0))
        return _View((rows, columns), at, inside, z, (rays * turned).sum(axis=1), turned[:, :2], spacing)

    @cached_property
    def nearest(self) -> Float[np.ndarray, "h w"]:
        """Depth image of the mesh by splats as large as its edges, in metres; infinite off the mesh."""
        rows, columns = self.window
        image = np.full((rows.stop - rows.start, columns.stop - columns.start), np.inf, np.float32)
        np.minimum.at(image, self.at, np.where(self.inside, self.z, np.inf).astype(np.float32))
        return cv2.erode(image, np.ones((2 * round(self.spacing) + 1,) * 2, np.uint8))

    @property
    def covered(self) -> np.ndarray:
        """Mask of the mesh in the image, dilated by ``spacing``."""
        return np.isfinite(self.nearest).astype(np.uint8)

    def in_front(self, fx: float, steepest: float) -> np.ndarray:
        """Return which vertices are not occluded by the mesh itself."""
        slant = 2 * self.spacing / fx * self.z / np.maximum(-self.cosine, steepest)  # depth range of a splat
        return self.inside & (self.z < self.nearest[self.at] + slant + 0.002)


def _around(index: np.ndarray, size: int) -> slice:
    """Return the range of rows or columns around the given ones, with a margin, inside the image."""
    if not len(index):
        return slice(0, 1)
    return slice(max(int(index.min()) - _MARGIN, 0), min(int(index.max()) + _MARGIN, size - 1) + 1)


def _depth_displacement(
    view: _View, seen: ObjectObservation, config: RefineConfig
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return precision, in 1/m², and displacement, in metres, of each vertex by the measured depth."""
    depth, at, cosine = seen.frame.depth[view.window], view.at, view.cosine
    usable = seen.mask[view.window] & (depth > 0)
    if seen.ignore is not None:
        usable &= ~seen.ignore[view.window]
    usable = cv2.erode(usable.astype(np.uint8), np.ones((2 * config.edge + 1,) * 2, np.uint8)) > 0
    window = 2 * max(1, round(view.spacing / 2)) + 1
    total = cv2.boxFilter(np.where(usable, depth, 0), -1, (window, window), normalize=False)
    count = cv2.boxFilter(usable.astype(np.float32), -1, (window, window), normalize=False)
    residual = total[at] / np.maximum(count[at], 1) - view.z
    good = view.in_front(seen.frame.intrinsics.fx, config.steepest)
    good &= (cosine < -config.steepest) & usable[at] & (count[at] > 0.5 * window**2)
    good &= np.abs(residual) < config.reach
    sigma2 = (config.depth_sigma * cosine) ** 2 / np.maximum(count[at], 1) + config.floor_sigma**2
    robust = np.minimum(1.0, 0.004 / np.maximum(np.abs(residual * cosine), 1e-6))
    return np.where(good, robust / sigma2, 0.0), residual * cosine


def _outline_displacement(
    view: _View, seen: ObjectObservation, plane: SupportPlane, config: RefineConfig
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return precision, in 1/m², and displacement, in metres, of each vertex by the outline of the object.

    Used are vertices on the outline of the mesh and vertices outside the outline of the object. The latter is
    the border between measured object and measured background, and independent of errors of the mask.
    """
    depth, at = seen.frame.depth[view.window], view.at
    known = depth > 0 if seen.ignore is None else (depth > 0) & ~seen.ignore[view.window]
    near, far = float(view.z.min()) - config.reach, float(view.z.max()) + config.reach
    height = _heights(seen.frame, plane, view)
    is_object = known & seen.mask[view.window] & (depth > near) & (depth < far) & (height > 0.004)
    behind = known & ~is_object & ((depth > near + 0.03) | (height < 0.004))
    inwards = cv2.distanceTransform((~behind).astype(np.uint8), cv2.DIST_L2, 3)
    outwards = cv2.distanceTransform((~is_object).astype(np.uint8), cv2.DIST_L2, 3)
    beyond = np.where(is_object[at], 0.5 - inwards[at], np.where(behind[at], outwards[at] - 0.5, 0.0))  # [px]
    slope = inwards - outwards  # decreases towards the background
    fall = -np.stack([cv2.Sobel(slope, cv2.CV_32F, *d)[at] for d in ((1, 0), (0, 1))], axis=1)
    length = np.linalg.norm(view.across, axis=1)
    along = (view.across * fall).sum(axis=1) / np.maximum(length * np.linalg.norm(fall, axis=1), 1e-9)
    rim = cv2.distanceTransform(view.covered, cv2.DIST_L2, 3)[at] < view.spacing + 2.0
    outline = rim & is_object[at] & (np.abs(view.cosine) < 0.5)
    sticks_out = behind[at] & (depth[at] > view.z + config.reach)
    moved = -beyond * view.z / seen.frame.intrinsics.fx / np.maximum(length, 0.3)
    good = view.inside & (outline | sticks_out) & (along > 0.7) & (length > 0.3)
    good &= np.abs(moved) < 2 * config.reach
    return np.where(good, config.outline_sigma**-2, 0.0), moved


def _heights(frame: RgbdFrame, plane: SupportPlane, view: _View) -> Float[np.ndarray, "h w"]:
    """Return the height of the measured points above the plane, in metres."""
    assert frame.T_world_camera is not None
    v, u = np.mgrid[view.window]
    points = pixel_rays(frame, u, v) * frame.depth[view.window][..., None]
    return plane.height_above(transform_points(frame.T_world_camera, points))


def _section_harmonics(
    vertices: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    T_world_object: Float[np.ndarray, "4 4"],
    orders: Sequence[int],
) -> Float[np.ndarray, "n k"]:
    """Return the displacements of the vertices along their normals by unit amplitudes of the harmonics.

    A change of the radius moves inner and outer walls alike: along the normal by its radial component.
    """
    local = transform_points(invert(T_world_object), vertices)[:, :2]
    radial = local - (local.min(axis=0) + local.max(axis=0)) / 2
    azimuth = np.arctan2(radial[:, 1], radial[:, 0])
    turned = (normals @ T_world_object[:3, :2] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])).sum(1)
    angles = azimuth[:, None] * np.array(orders)
    return turned[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def _map_displacement(
    links: sparse.csr_array,
    precision: Float[np.ndarray, "n"],
    information: Float[np.ndarray, "n"],
    shared: Float[np.ndarray, "n k"],
    sigmas: Float[np.ndarray, "k"],
    config: RefineConfig,
) -> Float[np.ndarray, "n"]:
    """Return the MAP displacement of each vertex: its own smooth component plus the shared ones."""
    n = len(precision)
    weighted = precision[:, None] * shared
    A = sparse.block_array(
        [
            [_posterior_precision(links, precision, config), sparse.csr_array(weighted)],
            [sparse.csr_array(weighted.T), sparse.csr_array(shared.T @ weighted + np.diag(sigmas**-2))],
        ]
    )
    x = _solved(sparse.csr_array(A), np.r_[information, shared.T @ information])
    return np.clip(x[:n] + shared @ x[n:], -config.limit, config.limit)


def _posterior_precision(
    links: sparse.csr_array, precision: np.ndarray, config: RefineConfig
) -> sparse.csr_array:
    """Return the posterior precision of the vertices' own displacements: smoothness, prior, measurements."""
    diagonal = links.sum(axis=1) + config.prior_sigma**-2 + precision
    return sparse.csr_array(sparse.diags_array(diagonal) - links)


def _solved(A: sparse.csr_array, b: np.ndarray) -> np.ndarray:
    """Solve A x = b for positive definite A by conjugate gradients, to a relative residual of 1e-3."""
    return cg(A, b, rtol=1e-3, maxiter=300, M=sparse.diags_array(1 / A.diagonal()))[0]
