"""Meshes of a cell's bodies for viewers, and the poses of the arm's bodies and sites.

mjviser converts MuJoCo's geoms to meshes; textures of boxes (table, walls) and roughness are added here. The
poses of objects are ground truth and therefore excluded.
"""

from __future__ import annotations

from typing import Any

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Float, Int
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from sim_assets.cell.world import World
from sim_assets.rendering.headless import MjModel, mujoco

COLLISION_GROUP = 3  # first geom group without visual geoms
TEXTURE_SIDE = 512  # [px] largest side of a texture in a viewer
LARGEST_MESH = 4000  # [triangles]; ten such objects stay interactive in a browser without a GPU
FINEST_TOLERANCE = 0.0005  # relative to the diagonal, of the first pass of simplification
SITES = ("tcp", "camera")
SCENERY = "world"


def body_meshes(world: World) -> dict[str, tuple[trimesh.Trimesh, ...]]:
    """Return the visual meshes of every body in its frame [m], by name; static geoms belong to ``world``."""
    model = world._model
    meshes: dict[str, list[trimesh.Trimesh]] = {}
    for geom in range(model.ngeom):
        if model.geom_group[geom] >= COLLISION_GROUP or model.geom_rgba[geom, 3] == 0:
            continue
        body = int(model.geom_bodyid[geom])
        mesh = _placed(_mesh(model, geom), model.geom_pos[geom], model.geom_quat[geom])
        if not model.body_weldid[body]:
            mesh = _placed(mesh, world._data.xpos[body], world._data.xquat[body])
        name = model.body(body).name if model.body_weldid[body] else SCENERY
        meshes.setdefault(name, []).append(mesh)
    return {name: _merged(parts) for name, parts in meshes.items()}


def moving_bodies(world: World) -> tuple[str, ...]:
    """Return the names of the rows of ``poses``: the arm's bodies, then the sites."""
    return (*(world._model.body(body).name for body in _arm_bodies(world._model)), *SITES)


def poses(world: World) -> Float[np.ndarray, "n 7"]:
    """Return positions [m] and quaternions wxyz of ``moving_bodies`` in the world frame."""
    data = world._data
    bodies = _arm_bodies(world._model)
    result = np.empty((len(bodies) + len(SITES), 7))
    result[: len(bodies)] = np.hstack([data.xpos[bodies], data.xquat[bodies]])
    sites = (world.arm.tcp_site, world.arm.camera_site)
    for row, site in enumerate(sites, start=len(bodies)):
        result[row, :3] = data.site(site).xpos
        mujoco.mju_mat2Quat(result[row, 3:], data.site(site).xmat)
    return result


def _arm_bodies(model: MjModel) -> list[int]:
    """Return the bodies moved by joints, free bodies excluded."""
    free = {int(body) for body in model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]}
    return [body for body in range(1, model.nbody) if model.body_weldid[body] and body not in free]


def _mesh(model: MjModel, geom: int) -> trimesh.Trimesh:
    """Return the mesh of a geom in its frame, with colour or texture."""
    from mjviser import conversions

    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = conversions.mujoco_mesh_to_trimesh(model, geom)
        mesh.merge_vertices()  # equal positions and texture coordinates: smooth shading, small files
    else:
        mesh = conversions.create_primitive_mesh(model, geom)
    material = int(model.geom_matid[geom])
    image = _texture(model, material)
    if image is not None and kind in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE):
        repeat = model.mat_texrepeat[material]
        mesh = _boxed(mesh, image, repeat, bool(model.mat_texuniform[material]))
    if not isinstance(mesh.visual, TextureVisuals):
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        mesh.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=_rgba(rgba)))
    shine = float(model.mat_shininess[material]) if material >= 0 else 0.3
    look = _material(mesh)
    look.roughnessFactor, look.metallicFactor = float(np.clip(1.0 - 0.75 * shine, 0.2, 1.0)), 0.0
    if look.baseColorTexture is not None:
        look.baseColorTexture.thumbnail((TEXTURE_SIDE, TEXTURE_SIDE))
    return mesh


def _rgba(rgba: np.ndarray) -> np.ndarray:
    """Convert MuJoCo's display colour to linear RGBA bytes, as glTF defines them."""
    linear = np.asarray(rgba, dtype=np.float64).copy()
    linear[:3] **= 2.2
    return np.rint(255 * linear).astype(np.uint8)


def _texture(model: MjModel, material: int) -> Image.Image | None:
    """Return the 2-D texture of a material, None without one; MuJoCo stores rows bottom up."""
    if material < 0:
        return None
    texture = int(model.mat_texid[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    if texture < 0 or int(model.tex_type[texture]) != int(mujoco.mjtTexture.mjTEXTURE_2D):
        return None
    rows, columns, channels = (
        int(size[texture]) for size in (model.tex_height, model.tex_width, model.tex_nchannel)
    )
    start = int(model.tex_adr[texture])
    data = np.asarray(model.tex_data[start : start + rows * columns * channels], dtype=np.uint8)
    return Image.fromarray(np.flipud(data.reshape(rows, columns, channels)[..., :3]).copy())


def _boxed(
    mesh: trimesh.Trimesh, image: Image.Image, repeat: Float[np.ndarray, "2"], uniform: bool
) -> trimesh.Trimesh:
    """Return a box textured on all sides, ``repeat`` times per side or, if uniform, per metre."""
    corners = mesh.vertices[mesh.faces]  # (f, 3 corners, 3)
    away = np.abs(mesh.face_normals).argmax(axis=1)
    across = np.array([(1, 2), (0, 2), (0, 1)])[away]  # the two axes that span each side
    places = np.take_along_axis(corners, across[:, None, :].repeat(3, axis=1), axis=2)
    if not uniform:
        low, size = mesh.bounds[0][across], np.maximum(np.ptp(mesh.bounds, axis=0)[across], 1e-9)
        places = (places - low[:, None]) / size[:, None]
    uv = (places * repeat).reshape(-1, 2)
    flat = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    flat.visual = TextureVisuals(uv=uv, material=PBRMaterial(baseColorTexture=image))
    return flat


def _placed(mesh: trimesh.Trimesh, position: np.ndarray, quat_wxyz: np.ndarray) -> trimesh.Trimesh:
    T_body_geom = trimesh.transformations.quaternion_matrix(quat_wxyz)
    T_body_geom[:3, 3] = position
    return mesh.apply_transform(T_body_geom)


def _merged(meshes: list[trimesh.Trimesh]) -> tuple[trimesh.Trimesh, ...]:
    """Merge untextured meshes of equal material, to save draw calls, and simplify large ones."""
    plain: dict[tuple[object, ...], list[trimesh.Trimesh]] = {}
    result: list[trimesh.Trimesh] = []
    for mesh in meshes:
        material = _material(mesh)
        if material.baseColorTexture is not None:
            result.append(mesh)
        else:
            key = (*material.baseColorFactor.tolist(), material.roughnessFactor)
            plain.setdefault(key, []).append(mesh)
    for parts in plain.values():
        whole = trimesh.Trimesh(*trimesh.util.append_faces(
            [part.vertices for part in parts], [part.faces for part in parts]
        ), process=False)  # fmt: skip
        whole.visual = TextureVisuals(material=_material(parts[0]))
        result.append(whole)
    return tuple(_simplified(mesh) for mesh in result)


def _simplified(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Reduce a mesh to ``LARGEST_MESH`` triangles; texture coordinates go along with the vertices.

    Each pass keeps the surface within a tolerance; vertices of what encloses no volume are clustered.
    (Decimation by quadric error fixes no position along flat and conical walls, where vertices leave the
    object.)
    """
    if len(mesh.faces) <= LARGEST_MESH:
        return mesh
    assert isinstance(mesh.visual, TextureVisuals)
    uv, tolerance = mesh.visual.uv, FINEST_TOLERANCE * mesh.scale
    rows = (mesh.vertices if uv is None else np.hstack([mesh.vertices, uv])).astype(np.float32)
    surface = manifold3d.Mesh(rows, mesh.faces.astype(np.uint32))
    surface.merge()
    solid, faces = manifold3d.Manifold(surface), mesh.faces
    while not solid.is_empty() and len(faces) > LARGEST_MESH:
        solid = solid.simplify(tolerance)
        if solid.is_empty():  # of many small parts none is left
            break
        reduced = solid.to_mesh()
        rows, faces, tolerance = reduced.vert_properties, reduced.tri_verts, 1.5 * tolerance
    while len(faces) > LARGEST_MESH:
        rows, faces = _clustered(rows, faces, tolerance)
        tolerance *= 1.5
    simple = trimesh.Trimesh(rows[:, :3], faces, process=False)
    simple.visual = TextureVisuals(uv=None if uv is None else rows[:, 3:], material=mesh.visual.material)
    return simple


def _clustered(
    rows: Float[np.ndarray, "v k"], faces: Int[np.ndarray, "f 3"], cell: float
) -> tuple[Float[np.ndarray, "u k"], Int[np.ndarray, "e 3"]]:
    """Replace the vertices in each cell [m] of a grid by the first of them; triangles without area go.

    Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993.
    """
    cells = np.floor(rows[:, :3] / cell).astype(int)
    _, first, became = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    merged = became.reshape(-1)[faces]
    a, b, c = merged.T
    return rows[first], merged[(a != b) & (b != c) & (c != a)]


def _material(mesh: trimesh.Trimesh) -> Any:
    assert isinstance(mesh.visual, TextureVisuals)
    return mesh.visual.material
