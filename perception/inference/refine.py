"""Refinement of a fitted mesh on the measured depth.

Code and pose fit a whole object with 25 numbers; what the views show is known better than that. Every vertex
moves along its normal by d. Where a view sees the vertex the measured depth asks for

    d_v = r_v (n_v . b_v),    r_v measured minus the vertex's depth, b_v its ray (z = 1), n_v its normal,

and a Gaussian prior says the rest: d is smooth over the surface, one part of it the same everywhere (a
surface too far out or in), and small where nothing is seen. The most probable d solves a sparse system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import trimesh
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import cg

from perception.geometry import invert, transform_points
from perception.inference.observation import ObjectObservation, pixel_rays
from perception.types import RgbdFrame, SupportPlane, TriangleMesh

_MARGIN = 24  # [px] of an image around the mesh that are looked at


@dataclass(frozen=True)
class RefineConfig:
    """Standard deviations and limits of the refinement.

    Attributes:
        depth_sigma: of one depth measurement [m].
        floor_sigma: of a vertex's mean measurement, whatever it averages over [m].
        prior_sigma: of the displacement where nothing is measured [m].
        common_sigma: of its part that is the same everywhere [m].
        roughness: how much the displacement changes over one edge of the mesh [m].
        reach: measurements farther from the vertex along the ray belong to something else [m].
        steepest: least cosine between ray and normal for a vertex to be measured.
        edge: pixels this near the mask's border are not used.
        outline_sigma: of the outline in a view [m].
        support_sigma: of the bottom's height over the support plane [m].
        limit: largest displacement [m].
        passes: how often what is seen of the moved vertices is looked up again.
        smoothing: passes of a filter that takes the voxels' staircase off the mesh first.
    """

    depth_sigma: float = 0.002
    floor_sigma: float = 0.0005
    prior_sigma: float = 0.003
    common_sigma: float = 0.002
    roughness: float = 0.0005
    reach: float = 0.012
    steepest: float = 0.25
    edge: int = 3
    outline_sigma: float = 0.001
    support_sigma: float = 0.0007
    limit: float = 0.006
    passes: int = 2
    smoothing: int = 5


@dataclass(frozen=True)
class RefinedMesh:
    """A mesh after measurements moved it.

    Attributes:
        mesh: its faces are as they were.
        determined: (n,) share of each vertex's place that the measurements decided, 0..1; the rest is prior.
    """

    mesh: TriangleMesh
    determined: Float[np.ndarray, "n"]


def refine_mesh(
    mesh_world: TriangleMesh,
    observations: Sequence[ObjectObservation],
    plane: SupportPlane,
    config: RefineConfig | None = None,
) -> RefinedMesh:
    """Return the mesh, in the world frame, with its vertices moved onto the measurements."""
    config = config or RefineConfig()
    start = _smoothed(mesh_world, config.smoothing)
    surface = trimesh.Trimesh(start, mesh_world.faces, process=False)
    normals = np.asarray(surface.vertex_normals)
    links = _links(surface) * config.roughness**-2
    d, precision = np.zeros(len(normals)), np.zeros(len(normals))
    moved = start
    for _ in range(config.passes):  # a vertex that has moved is seen elsewhere
        precision, asked = _asked(surface, moved, normals, observations, plane, config)
        d = _most_probable(links, precision, precision * d + asked, config)
        moved = start + d[:, None] * normals
    # Displacements are linear in what is measured: were that 1 everywhere, this much would come of it.
    determined = np.clip(_solved(_stiffness(links, precision, config), precision), 0.0, 1.0)
    moved = moved - np.minimum(plane.height_above(moved), 0.0)[:, None] * plane.normal  # not into the plane
    return RefinedMesh(TriangleMesh(moved, mesh_world.faces), determined)


def _smoothed(mesh: TriangleMesh, passes: int) -> Float[np.ndarray, "n 3"]:
    """The vertices after a low-pass filter that does not shrink (Taubin, SIGGRAPH 1995)."""
    vertices = mesh.vertices
    links = _links(trimesh.Trimesh(vertices, mesh.faces, process=False))
    mean = sparse.diags_array(1 / links.sum(axis=1)) @ links
    for factor in (0.5, -0.53) * passes:
        vertices = vertices + factor * (mean @ vertices - vertices)
    return vertices


def _links(surface: trimesh.Trimesh) -> sparse.csr_array:
    """1 for every two vertices that share an edge."""
    i, j = np.asarray(surface.edges_unique).T
    n = len(surface.vertices)
    return sparse.coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n, n)).tocsr()


def _asked(
    surface: trimesh.Trimesh,
    vertices: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    observations: Sequence[ObjectObservation],
    plane: SupportPlane,
    config: RefineConfig,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """What all measurements ask of the vertices where they are: precision, and displacement times that."""
    height = plane.height_above(vertices)
    lowest = (normals @ plane.normal < -0.7) & (height < height.min() + 0.002)
    precision = lowest / config.support_sigma**2
    asked = precision * height  # along the normal, which points down
    for seen in observations:
        view = _View.of(surface, vertices, normals, seen)
        for w, d in (_measured(view, seen, config), _outlined(view, seen, plane, config)):
            precision = precision + w
            asked = asked + w * d
    return precision, asked


@dataclass(frozen=True)
class _View:
    """Vertices in one image, of which only the window around them matters.

    Attributes:
        window: rows and columns of the image.
        at: row and column of each vertex in the window, (0, 0) outside the image.
        inside: whether it is in the image.
        z: its depth [m].
        cosine: of its normal and its ray (z = 1), negative towards the camera.
        across: (n, 2) its normal's components along the image's x and y.
        spacing: of the mesh in the image [px].
    """

    window: tuple[slice, slice]
    at: tuple[np.ndarray, np.ndarray]
    inside: np.ndarray
    z: np.ndarray
    cosine: np.ndarray
    across: np.ndarray
    spacing: float

    @staticmethod
    def of(
        surface: trimesh.Trimesh, vertices: np.ndarray, normals: np.ndarray, seen: ObjectObservation
    ) -> _View:
        camera, T_camera_world = seen.frame.intrinsics, invert(seen.T_world_camera)
        points = transform_points(T_camera_world, vertices)
        z = np.maximum(points[:, 2], 1e-3)
        rays = points / z[:, None]
        u = np.rint(camera.fx * rays[:, 0] + camera.cx).astype(int)
        v = np.rint(camera.fy * rays[:, 1] + camera.cy).astype(int)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (points[:, 2] > 0.01)
        turned = normals @ T_camera_world[:3, :3].T
        spacing = float(np.median(surface.edges_unique_length)) * camera.fx / float(np.median(z))
        rows, columns = (
            _around(index[inside], size) for index, size in ((v, camera.height), (u, camera.width))
        )
        at = (np.where(inside, v - rows.start, 0), np.where(inside, u - columns.start, 0))
        return _View((rows, columns), at, inside, z, (rays * turned).sum(axis=1), turned[:, :2], spacing)

    @cached_property
    def nearest(self) -> Float[np.ndarray, "h w"]:
        """Depth of the mesh in [m], infinite beside it: splats that reach as far as its edges."""
        rows, columns = self.window
        image = np.full((rows.stop - rows.start, columns.stop - columns.start), np.inf, np.float32)
        np.minimum.at(image, self.at, np.where(self.inside, self.z, np.inf).astype(np.float32))
        return cv2.erode(image, np.ones((2 * round(self.spacing) + 1,) * 2, np.uint8))

    @property
    def covered(self) -> np.ndarray:
        """Where the mesh is in the image, wider by ``spacing``."""
        return np.isfinite(self.nearest).astype(np.uint8)

    def in_front(self, fx: float, steepest: float) -> np.ndarray:
        """Which vertices no other part of the mesh hides."""
        slant = 2 * self.spacing / fx * self.z / np.maximum(-self.cosine, steepest)  # depth within a splat
        return self.inside & (self.z < self.nearest[self.at] + slant + 0.002)


def _around(index: np.ndarray, size: int) -> slice:
    """Rows or columns of an image around those given."""
    if not len(index):
        return slice(0, 1)
    return slice(max(int(index.min()) - _MARGIN, 0), min(int(index.max()) + _MARGIN, size - 1) + 1)


def _measured(
    view: _View, seen: ObjectObservation, config: RefineConfig
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Precision [1/m^2] and displacement [m] that the measured depth asks of every vertex."""
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


def _outlined(
    view: _View, seen: ObjectObservation, plane: SupportPlane, config: RefineConfig
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """The same for the vertices on the mesh's outline in the image, and those beyond the object's.

    The object's outline lies where measured object and measured background meet; that its mask may be too
    wide or too narrow does not matter.
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
    slope = inwards - outwards  # falls towards the background
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
    """Height of the measured points above the plane [m]."""
    assert frame.T_world_camera is not None
    v, u = np.mgrid[view.window]
    points = pixel_rays(frame, u, v) * frame.depth[view.window][..., None]
    return plane.height_above(transform_points(frame.T_world_camera, points))


def _most_probable(
    links: sparse.csr_array, precision: np.ndarray, target: np.ndarray, config: RefineConfig
) -> Float[np.ndarray, "n"]:
    """Displacement of every vertex: a smooth part of its own and one common to all."""
    n = len(precision)
    common = np.array([[precision.sum() + config.common_sigma**-2]])
    A = sparse.block_array(
        [
            [_stiffness(links, precision, config), sparse.csr_array(precision[:, None])],
            [sparse.csr_array(precision[None]), common],
        ]
    )
    x = _solved(sparse.csr_array(A), np.r_[target, target.sum()])
    return np.clip(x[:n] + x[n], -config.limit, config.limit)


def _stiffness(links: sparse.csr_array, precision: np.ndarray, config: RefineConfig) -> sparse.csr_array:
    """Of vertices' own displacements: to their neighbours', to none, and to what is measured."""
    diagonal = links.sum(axis=1) + config.prior_sigma**-2 + precision
    return sparse.csr_array(sparse.diags_array(diagonal) - links)


def _solved(A: sparse.csr_array, b: np.ndarray) -> np.ndarray:
    """A^-1 b to three digits, A positive definite."""
    return cg(A, b, rtol=1e-3, maxiter=300, M=sparse.diags_array(1 / A.diagonal()))[0]
