"""Convex pieces for the meshes of a hand with one moving jaw.

MuJoCo collides the convex hull of a mesh. That of a bracket with a fixed jaw fills the space between the
jaws, so such meshes are cut across their longest side into slabs, and each connected part of a slab is
replaced by its hull. The surface alone is used: meshes need not be watertight.
"""

from __future__ import annotations

import functools

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from sim_assets.rendering.headless import MjModel, MjsBody, MjSpec, mujoco

SLAB = 0.008  # [m]
_SPACING = 0.003  # [m], largest edge of the triangles that are assigned to slabs
_CONVEX = 0.8  # volume of the pieces relative to that of the hull from which on a mesh stays as it is
_LEAST_POINTS = 6  # of a part


def split_meshes(spec: MjSpec, body: MjsBody) -> None:
    """Replace the concave collision meshes of a body and of all below it by convex pieces."""
    geoms = [geom for geom in _all_geoms(body) if geom.contype and geom.type == mujoco.mjtGeom.mjGEOM_MESH]
    if not geoms:
        return
    model = spec.copy().compile()
    names: dict[str, list[str]] = {}
    for geom in geoms:
        if geom.meshname not in names:
            names[geom.meshname] = _add_pieces(spec, geom.meshname, model)
        for name in names[geom.meshname]:
            geom.parent.add_geom(
                name=f"{geom.name}/{name}", type=geom.type, meshname=name, pos=geom.pos, quat=geom.quat,
                group=geom.group, contype=geom.contype, conaffinity=geom.conaffinity, rgba=geom.rgba,
                density=0,
            )  # fmt: skip
        if names[geom.meshname]:
            geom.contype = geom.conaffinity = 0


def _all_geoms(body: MjsBody) -> list:
    return [*body.geoms, *(geom for child in body.bodies for geom in _all_geoms(child))]


def _add_pieces(spec: MjSpec, mesh: str, model: MjModel) -> list[str]:
    """Add the pieces of a mesh to a specification; return their names, none if it is nearly convex."""
    index = model.mesh(mesh).id
    start, count = model.mesh_vertadr[index], model.mesh_vertnum[index]
    first, n_faces = model.mesh_faceadr[index], model.mesh_facenum[index]
    turn = Rotation.from_quat(model.mesh_quat[index], scalar_first=True)
    vertices = turn.apply(model.mesh_vert[start : start + count]) + model.mesh_pos[index]
    names = []
    faces = model.mesh_face[first : first + n_faces]
    for number, piece in enumerate(convex_parts(vertices, faces)):
        names.append(f"{mesh}/{number}")
        spec.add_mesh(
            name=names[-1], uservert=piece.astype(np.float32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )  # fmt: skip
    return names


def convex_parts(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "_ 3"], ...]:
    """Return the corners of convex parts of a mesh in [m]; none if its hull is hardly larger."""
    return _convex_parts(vertices.astype(np.float64).tobytes(), faces.astype(np.int64).tobytes())


@functools.lru_cache(maxsize=16)
def _convex_parts(vertex_bytes: bytes, face_bytes: bytes) -> tuple[np.ndarray, ...]:
    vertices = np.frombuffer(vertex_bytes).reshape(-1, 3)
    faces = np.frombuffer(face_bytes, dtype=np.int64).reshape(-1, 3)
    points, triangles = trimesh.remesh.subdivide_to_size(vertices, faces, _SPACING, max_iter=12)[:2]
    points, inverse = np.unique(np.round(points, 6), axis=0, return_inverse=True)
    triangles = inverse.reshape(-1)[triangles]
    axis = int(np.ptp(points, axis=0).argmax())
    along = points[:, axis]
    slabs = np.linspace(along.min(), along.max(), max(int(np.ceil(np.ptp(along) / SLAB)), 1) + 1)
    slab = np.digitize(along[triangles].mean(axis=1), slabs[1:-1])
    parts = [part for k in range(len(slabs) - 1) for part in _hulls(points, triangles[slab == k])]
    shares = [min(1.0, (slabs[1] - slabs[0]) / np.ptp(part[:, axis])) for part in parts]  # parts overlap
    volume = sum(share * ConvexHull(part).volume for share, part in zip(shares, parts, strict=True))
    return () if volume > _CONVEX * ConvexHull(points).volume else tuple(parts)


def _hulls(points: Float[np.ndarray, "n 3"], triangles: Int[np.ndarray, "m 3"]) -> list[np.ndarray]:
    """Return the corners of the hull of each connected part of some triangles."""
    if not len(triangles):
        return []
    used, local = np.unique(triangles, return_inverse=True)
    local = local.reshape(-1, 3)
    pairs = np.concatenate([local[:, :2], local[:, 1:]])
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(used), len(used)))
    found = []
    for part in range((labels := connected_components(links, directed=False))[0]):
        corners = points[used[labels[1] == part]]
        if len(corners) < _LEAST_POINTS:
            continue
        try:
            found.append(corners[ConvexHull(corners).vertices])
        except QhullError:  # flat
            continue
    return found
