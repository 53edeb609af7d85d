"""Attachment of a user's MJCF arm to a scene, and its reduction to the planning model.

Collision geoms are those of group 3, as in MuJoCo Menagerie; all others are visual. Gravity is compensated on
the arm's bodies, as a real arm's controller does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, MjsBody, MjSpec, mujoco
from sim_assets.robots.mjcf_limits import check_mjcf
from sim_assets.robots.simulated_arm import ARM_CONTACT, PAD_CONTACT, WRIST_CAMERA

COLLISION_GROUP = 3
PREFIX = "robot_"  # prefix of the arm's names in scenes and in planning


@dataclass(frozen=True)
class Frame:
    """Pose in the parent frame: position in [m], quaternion wxyz."""

    position: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]


@dataclass(frozen=True)
class Mount:
    """MJCF file of an arm and its pose in the scene.

    Attributes:
        mjcf: path of the arm's MJCF file.
        base: pose of the file's world in the scene's.
        camera_site: site of the wrist camera's optical frame (OpenCV axes).
        fingers: names of the finger joints; collision geoms below them are pads.
        sites: name, body and pose of the sites to add.
    """

    mjcf: Path
    base: Frame
    camera_site: str
    fingers: tuple[str, ...]
    sites: tuple[tuple[str, str, Frame], ...] = ()


def load(mount: Mount) -> MjSpec:
    """Load the arm's specification and add its sites.

    Raises:
        RobotFileError: the file is missing, is not MJCF, or lacks a body or joint.
    """
    if not mount.mjcf.is_file():
        raise RobotFileError(f"{mount.mjcf}: no such MJCF file")
    check_mjcf(mount.mjcf)
    try:
        spec = mujoco.MjSpec.from_file(str(mount.mjcf))
    except (ValueError, mujoco.FatalError) as error:
        raise RobotFileError(f"{mount.mjcf} cannot be read as MJCF: {error}") from None
    for element in (*spec.keys, *spec.lights, *spec.pairs):  # the scene has its own
        spec.delete(element)
    spec.compiler.fusestatic = spec.compiler.discardvisual = False
    for name, body_name, frame in mount.sites:
        body = spec.body(body_name)
        if body is None:
            raise RobotFileError(
                f"{mount.mjcf} has no body '{body_name}', on which the robot file places a site"
            )
        body.add_site(name=name, pos=frame.position, quat=frame.quaternion)
    _suit_contacts(spec, mount)
    for body in spec.bodies:
        if body.name != "world":
            body.gravcomp = 1
    return spec


def add_to_scene(mount: Mount, spec: MjSpec, fovy: float) -> None:
    """Add the arm, and the camera ``wrist`` with a vertical field of view ``fovy`` in [deg]."""
    child = load(mount)
    model = child.compile()
    optical = model.site(mount.camera_site)
    turn = Rotation.from_quat(optical.quat, scalar_first=True) * Rotation.from_euler("x", np.pi)
    _attach(spec, child, mount.base)
    spec.site(PREFIX + mount.camera_site).parent.add_camera(
        name=WRIST_CAMERA, pos=optical.pos, quat=turn.as_quat(scalar_first=True), fovy=fovy
    )  # MuJoCo's camera looks along -z, y up


def planning_mjcf(mount: Mount, model: MjModel) -> str:
    """Return the arm's kinematic chain and collision geoms as self-contained MJCF.

    Args:
        model: compiled from the same specification.
    """
    child = load(mount)
    for geom in list(child.geoms):
        geom.material = ""
        if geom.group != COLLISION_GROUP:
            child.delete(geom)
    used = {geom.meshname for geom in child.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH}
    for mesh in list(child.meshes):
        if mesh.name in used:
            _embed(child, mesh.name, model)
        else:
            child.delete(mesh)
    unseen = (child.materials, child.textures, child.skins, child.hfields, child.sensors)
    for element in [element for elements in unseen for element in elements]:
        child.delete(element)
    spec = mujoco.MjSpec()
    spec.modelname = "arm"
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-6  # visual geoms were removed
    _attach(spec, child, mount.base)
    spec.compile()
    return spec.to_xml()


def _attach(spec: MjSpec, child: MjSpec, base: Frame) -> None:
    # The scene's options (time step, gravity) override the file's, without warnings.
    for given, kept in ((child.option, spec.option), (child.visual.map, spec.visual.map)):
        _set(given, **{name: getattr(kept, name) for name in dir(kept) if not name.startswith("_")})
    child.memory, child.nuserdata = spec.memory, spec.nuserdata
    frame = spec.worldbody.add_frame(pos=base.position, quat=base.quaternion)
    spec.attach(child, frame=frame, prefix=PREFIX)


def _suit_contacts(spec: MjSpec, mount: Mount) -> None:
    """Set collision filters (none within the arm or with visual geoms) and the pads' contact parameters."""
    for geom in spec.geoms:
        touches = geom.group == COLLISION_GROUP
        _set(geom, **(ARM_CONTACT if touches else {"contype": 0, "conaffinity": 0}))
    for name in mount.fingers:
        joint = spec.joint(name)
        if joint is None:
            raise RobotFileError(f"{mount.mjcf} has no joint '{name}' of the robot file's [gripper]")
        for geom in _geoms_below(joint.parent):
            if geom.group == COLLISION_GROUP:
                _set(geom, **PAD_CONTACT)


def _geoms_below(body: MjsBody) -> list:
    return [*body.geoms, *(geom for child in body.bodies for geom in _geoms_below(child))]


def _set(element: object, **values: object) -> None:
    for name, value in values.items():
        setattr(element, name, value)


def _embed(spec: MjSpec, name: str, model: MjModel) -> None:
    """Replace a mesh file by its compiled vertices in the file's frame."""
    mesh, index = spec.mesh(name), model.mesh(name).id
    start = model.mesh_vertadr[index]
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[index]]
    turn = Rotation.from_quat(model.mesh_quat[index], scalar_first=True)
    mesh.file = ""
    mesh.scale, mesh.refpos, mesh.refquat = (1, 1, 1), (0, 0, 0), (1, 0, 0, 0)
    mesh.uservert = (turn.apply(vertices) + model.mesh_pos[index]).astype(np.float32).ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
