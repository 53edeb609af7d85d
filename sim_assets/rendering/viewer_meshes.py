"""What the bodies of a cell look like, as meshes for viewers, and where arm and sites are.

mjviser turns MuJoCo's geoms into meshes. What it leaves out is added here: textures on boxes (table, walls),
and how glossy a material is. Shapes only: where the objects stand is read in ``ground_truth`` alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from sim_assets.cell.world import World
from sim_assets.rendering.headless import MjModel, mujoco

COLLISION_GROUP = 3  # geoms from here on are for touching, not for looking at
TEXTURE_SIDE = 512  # [px] largest side of a texture in a viewer
LARGEST_MESH = 4000  # [triangles] a browser without a GPU draws ten such objects and stays responsive
SITES = ("tcp", "camera")
SCENERY = "world"


def body_meshes(world: World) -> dict[str, tuple[trimesh.Trimesh, ...]]:
    """The visible meshes of every body by its name, in its frame in [m]; what stands fast is ``world``."""
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
    """Names of what ``poses`` tells the poses of: the arm's bodies, then the sites."""
    return (*(world._model.body(body).name for body in _arm_bodies(world._model)), *SITES)


def poses(world: World) -> Float[np.ndarray, "n 7"]:
    """Position [m] and quaternion wxyz in the world of ``moving_bodies``."""
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
    """Bodies that joints move, free bodies left out."""
    free = {int(body) for body in model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]}
    return [body for body in range(1, model.nbody) if model.body_weldid[body] and body not in free]


def _mesh(model: MjModel, geom: int) -> trimesh.Trimesh:
    """One geom in its own frame, with colour or texture."""
    from mjviser import conversions

    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = conversions.mujoco_mesh_to_trimesh(model, geom)
        mesh.merge_vertices()  # corners of one place and one texture coordinate: smooth shading, small files
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
    """As bytes, linear as glTF wants it: MuJoCo's colours are meant for the screen."""
    linear = np.asarray(rgba, dtype=np.float64).copy()
    linear[:3] **= 2.2
    return np.rint(255 * linear).astype(np.uint8)


def _texture(model: MjModel, material: int) -> Image.Image | None:
    """The plain 2-D texture of a material, if it has one; images start at the top, MuJoCo's at the bottom."""
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
    """A box whose every side shows the texture, ``repeat`` times a side or, if uniform, every metre."""
    corners = mesh.vertices[mesh.faces]  # (f, 3 corners, 3)
    away = np.abs(mesh.face_normals).argmax(axis=1)
    across = np.array([(1, 2), (0, 2), (0, 1)])[away]  # the two axes along each side
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
    """Plain meshes of one colour and gloss become one (a viewer draws each apart), large ones simple."""
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
    """At most ``LARGEST_MESH`` triangles; corners keep texture coordinates of the nearest they stand for."""
    import fast_simplification

    if len(mesh.faces) <= LARGEST_MESH:
        return mesh
    *_, collapses = fast_simplification.simplify(
        mesh.vertices, mesh.faces, target_count=LARGEST_MESH, return_collapses=True
    )
    vertices, faces, became = fast_simplification.replay_simplification(
        mesh.vertices.astype(np.float32), mesh.faces, collapses
    )
    simple = trimesh.Trimesh(vertices, faces, process=False)
    assert isinstance(mesh.visual, TextureVisuals)
    uv = mesh.visual.uv
    if uv is not None:
        far_first = np.argsort(-np.linalg.norm(vertices[became] - mesh.vertices, axis=1))
        uv_simple = np.zeros((len(vertices), 2))
        uv_simple[became[far_first]] = uv[far_first]
        uv = uv_simple
    simple.visual = TextureVisuals(uv=uv, material=mesh.visual.material)
    return simple


def _material(mesh: trimesh.Trimesh) -> Any:
    assert isinstance(mesh.visual, TextureVisuals)
    return mesh.visual.material
