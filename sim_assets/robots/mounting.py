"""Composition of a user's arm from MJCF files, and its attachment to a scene.

A file is taken as it comes: with scenery, keyframes and lights (left out), unnamed parts (named), collision
geoms in any group. Gravity is compensated on the arm's bodies, as a real arm's controller does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, MjsBody, MjSpec, mujoco
from sim_assets.robots.mjcf_limits import check_mjcf
from sim_assets.robots.pedestal import pedestal_of
from sim_assets.robots.servos import GripperServo, JointServo, add_gripper_servo, add_joint_servos
from sim_assets.robots.simulated_arm import ARM_CONTACT, WRIST_CAMERA
from sim_assets.robots.solid_geoms import is_solid, set_contacts

PREFIX = "robot_"  # prefix of the arm's names in scenes and in planning
_VERTICAL = 0.99  # least vertical component of an axis that counts as vertical
HAND_PREFIX = "hand_"  # prefix of the names of a hand from a file of its own


@dataclass(frozen=True)
class Frame:
    """Pose in the parent frame: position in [m], quaternion wxyz."""

    position: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]


@dataclass(frozen=True)
class SitePose:
    """A site to add: its name, the body that carries it, and its pose there."""

    name: str
    body: str
    frame: Frame


@dataclass(frozen=True)
class HandFile:
    """A hand in an MJCF file of its own.

    Attributes:
        mjcf: path of the file.
        mount: site or body of the arm that carries the hand.
        frame: pose of the file's world in the mount.
    """

    mjcf: Path
    mount: str
    frame: Frame


@dataclass(frozen=True)
class Mount:
    """An arm's MJCF files, what is added to them, and the pose in the scene.

    Attributes:
        mjcf: path of the arm's file.
        base: pose of the file's world in the scene's.
        joints: names of the arm's joints, base to wrist.
        root: name of the body at which the arm begins, of a file with more than that; empty to keep all.
        hand: hand from a file of its own.
        sites: sites to add.
        camera_site: site of the wrist camera's optical frame (OpenCV axes); empty while unknown.
        servos: position servos to add, in place of the actuators of their joints.
        gripper: servo of the hand to add, in place of its actuators.
    """

    mjcf: Path
    base: Frame
    joints: tuple[str, ...]
    root: str = ""
    hand: HandFile | None = None
    sites: tuple[SitePose, ...] = ()
    camera_site: str = ""
    servos: tuple[JointServo, ...] = ()
    gripper: GripperServo | None = None


def load(mount: Mount, visuals: bool = True) -> MjSpec:
    """Load and normalise the arm's specification: solid geoms have contact bits, visual ones have none.

    Args:
        mount: the files.
        visuals: whether to keep visual geoms that no inertia depends on.

    Raises:
        RobotFileError: a file is missing, is not MJCF, or lacks a body or site.
    """
    spec = _read(mount.mjcf)
    if mount.root:
        _keep_only(spec, mount)
    if mount.hand is not None:
        _add_hand(spec, mount)
    for geom in list(spec.worldbody.geoms):
        if geom.type in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD):  # the floor of a scene
            spec.delete(geom)
    _name_parts(spec)
    _limit_joints(spec, mount)
    set_contacts(spec, mount.joints[-1] if mount.joints else "")
    if not visuals:
        _strip(spec)
    for site in mount.sites:
        body = spec.body(site.body)
        if body is None:
            raise RobotFileError(f"{mount.mjcf} has no body '{site.body}', on which the file places a site")
        body.add_site(name=site.name, pos=site.frame.position, quat=site.frame.quaternion)
    add_joint_servos(spec, mount.servos)
    if mount.gripper is not None:
        add_gripper_servo(spec, mount.gripper)
    for body in spec.bodies:
        if body.name != "world":
            body.gravcomp = 1
    return spec


def add_to_scene(mount: Mount, spec: MjSpec, fovy: float) -> None:
    """Add the arm, and the camera ``wrist`` with a vertical field of view ``fovy`` in [deg]."""
    child = load(mount)
    model = load(mount, visuals=False).compile()
    optical = model.site(mount.camera_site)
    column = pedestal_of(model, mount.joints[0], mount.base.position, mount.base.quaternion)
    if column is not None:
        spec.worldbody.add_geom(
            name=PREFIX + "pedestal", rgba=(0.35, 0.36, 0.38, 1), **column.shape, **ARM_CONTACT
        )
    turn = Rotation.from_quat(optical.quat, scalar_first=True) * Rotation.from_euler("x", np.pi)
    _attach(spec, child, mount.base)
    for body in _turning_links(model, mount):  # a link that only turns over the table may graze it
        spec.add_exclude(bodyname1="world", bodyname2=PREFIX + body)
    spec.site(PREFIX + mount.camera_site).parent.add_camera(
        name=WRIST_CAMERA, pos=optical.pos, quat=turn.as_quat(scalar_first=True), fovy=fovy
    )  # MuJoCo's camera looks along -z, y up


def _turning_links(model: MjModel, mount: Mount) -> list[str]:
    """Return the bodies that the first joint alone moves, if its axis is vertical in the scene."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    first = model.joint(mount.joints[0])
    axis = Rotation.from_quat(mount.base.quaternion, scalar_first=True).apply(data.xaxis[first.id])
    if abs(axis[2]) < _VERTICAL:
        return []
    return [model.body(b).name for b in np.flatnonzero(model.body_weldid == first.bodyid[0])]


def compiled(mount: Mount, visuals: bool = False) -> MjModel:
    """Compile the arm alone.

    Raises:
        RobotFileError: a file is unusable.
    """
    try:
        return load(mount, visuals).compile()
    except RobotFileError:
        raise
    except (ValueError, mujoco.FatalError) as error:
        raise RobotFileError(f"{mount.mjcf.name} does not compile: {' '.join(str(error).split())}") from None


def _read(path: Path) -> MjSpec:
    if not path.is_file():
        raise RobotFileError(f"{path}: no such MJCF file")
    check_mjcf(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise RobotFileError(f"{path} cannot be read as MJCF: {' '.join(str(error).split())}") from None
    _check_references(path, spec)
    if _is_in_radians(spec):
        spec.compiler.degree = False
    for element in (*spec.keys, *spec.lights, *spec.pairs):  # the scene has its own
        spec.delete(element)
    spec.compiler.fusestatic = spec.compiler.discardvisual = False
    return spec


def _is_in_radians(spec: MjSpec) -> bool:
    """Return whether all ranges of hinges fit into a turn in radians, as in fragments of larger models.

    These leave out ``angle="radian"``, since the model that includes them has it; MuJoCo reads degrees.
    """
    hinges = [joint.range for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE]
    largest = float(np.abs(hinges).max(initial=0.0)) if hinges else 0.0
    return bool(spec.compiler.degree and 0 < largest <= 2 * np.pi)


def _check_references(path: Path, spec: MjSpec) -> None:
    """Raise RobotFileError for a material or mesh that does not exist; the bare model would not show it."""
    materials, meshes = {m.name for m in spec.materials}, {m.name for m in spec.meshes}
    for geom in spec.geoms:
        for kind, name, known in (("material", geom.material, materials), ("mesh", geom.meshname, meshes)):
            if name and name not in known:
                raise RobotFileError(f"{path}: geom '{geom.name}' has an unknown {kind} '{name}'")
    files = [("mesh", spec.meshdir, mesh.file) for mesh in spec.meshes]
    files += [("texture", spec.texturedir, texture.file) for texture in spec.textures]
    missing = [
        f"{path}: {kind} file {path.parent / folder / file} is missing"
        for kind, folder, file in files
        if file and not (path.parent / folder / file).exists() and not (path.parent / file).exists()
    ]
    if missing:
        raise RobotFileError(
            missing if len(missing) < 4 else [*missing[:3], f"{path}: ... {len(missing)} files in all"]
        )


def _keep_only(spec: MjSpec, mount: Mount) -> None:
    """Delete all but the arm that begins at body ``mount.root``, and hold the joints that lead to it.

    Of the bodies that carry it, those without joints and other moving parts keep their geoms: its base.
    """
    kept = spec.body(mount.root)
    if kept is None:
        roots = ", ".join(body.name for body in spec.worldbody.bodies if body.name)
        raise RobotFileError(f"{mount.mjcf} has no body '{mount.root}' ([arm] body); it has {roots}")
    while kept.name != "world":
        carrier = kept.parent
        others = [body for body in carrier.bodies if body.name != kept.name]
        if carrier.name == "world" or carrier.joints or any(map(_has_joints, others)):
            for part in (*others, *carrier.geoms):
                spec.delete(part)
            for joint in list(carrier.joints):
                _delete_joint(spec, joint)
        kept = carrier
    left = {body.name for body in spec.bodies}
    for camera in list(
        spec.cameras
    ):  # MuJoCo keeps cameras that look at a deleted body, and then refuses the model
        if camera.targetbody and camera.targetbody not in left:
            spec.delete(camera)


def _has_joints(body: MjsBody) -> bool:
    return bool(body.joints) or any(map(_has_joints, body.bodies))


def _delete_joint(spec: MjSpec, joint: Any) -> None:
    """Delete a joint, and the actuators, equalities and sensors that act on it."""
    for element in (*spec.actuators, *spec.equalities, *spec.sensors):
        if joint.name in _targets(element):
            spec.delete(element)
    spec.delete(joint)


def _targets(element: Any) -> set[str]:
    """Return the names of the parts that an actuator, equality or sensor refers to."""
    return {getattr(element, key) for key in ("target", "name1", "name2", "objname") if hasattr(element, key)}


def _add_hand(spec: MjSpec, mount: Mount) -> None:
    assert mount.hand is not None
    child = _read(mount.hand.mjcf)
    _adopt_options(child, spec)
    site, body = spec.site(mount.hand.mount), spec.body(mount.hand.mount)
    if site is None and body is None:
        sites = ", ".join(s.name for s in spec.sites if s.name) or "none"
        raise RobotFileError(
            f"{mount.mjcf} has no site or body '{mount.hand.mount}' ([hand] mount); its sites are {sites}"
        )
    parent = body if site is None else site.parent
    pose = mount.hand.frame
    position, turn = pose.position, Rotation.from_quat(pose.quaternion, scalar_first=True)
    if site is not None:
        site_turn = _orientation(spec, mount.hand.mount)
        position, turn = site.pos + site_turn.apply(position), site_turn * turn
    frame = parent.add_frame(pos=position, quat=turn.as_quat(scalar_first=True))
    spec.attach(child, frame=frame, prefix=HAND_PREFIX)


def _orientation(spec: MjSpec, site: str) -> Rotation:
    """Return a site's orientation in its body, whatever form the file gives it in."""
    if spec.site(site).alt.type == mujoco.mjtOrientation.mjORIENTATION_QUAT:
        return Rotation.from_quat(spec.site(site).quat, scalar_first=True)
    return Rotation.from_quat(spec.copy().compile().site(site).quat, scalar_first=True)


def _name_parts(spec: MjSpec) -> None:
    """Name all bodies, geoms, joints, tendons and actuators that have no name."""
    for kind in ("bodies", "geoms", "joints", "tendons", "actuators"):
        elements = list(getattr(spec, kind))
        names = {element.name for element in elements}
        for index, element in enumerate(elements):
            if not element.name:
                name = f"{kind}_{index}"
                element.name = name if name not in names else f"unnamed_{name}"


def _limit_joints(spec: MjSpec, mount: Mount) -> None:
    """Give the arm's joints that turn without end a range of one turn either way."""
    for name in mount.joints:
        joint = spec.joint(name)
        if joint is None or joint.type != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        unlimited = joint.limited == mujoco.mjtLimited.mjLIMITED_FALSE
        if unlimited or (joint.limited == mujoco.mjtLimited.mjLIMITED_AUTO and not np.any(joint.range)):
            turn = 360.0 if spec.compiler.degree else 2 * np.pi
            joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, (-turn, turn)


def _strip(spec: MjSpec) -> None:
    """Delete textures, unused meshes, and the visual geoms that no body's inertia comes from."""
    for body in spec.bodies:
        if body.name == "world" or body.explicitinertial:
            for geom in list(body.geoms):
                if not is_solid(geom):
                    spec.delete(geom)
    for geom in spec.geoms:
        geom.material = ""
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
    for element in (*spec.materials, *spec.textures, *spec.skins):
        spec.delete(element)


def _attach(spec: MjSpec, child: MjSpec, base: Frame) -> None:
    _adopt_options(child, spec)
    frame = spec.worldbody.add_frame(pos=base.position, quat=base.quaternion)
    spec.attach(child, frame=frame, prefix=PREFIX)


def _adopt_options(child: MjSpec, spec: MjSpec) -> None:
    """Give a file the options (time step, gravity) of the one it is attached to, which override its own."""
    for given, kept in ((child.option, spec.option), (child.visual.map, spec.visual.map)):
        _set(given, **{name: getattr(kept, name) for name in dir(kept) if not name.startswith("_")})
    child.memory, child.nuserdata = spec.memory, spec.nuserdata


def _set(element: object, **values: object) -> None:
    for name, value in values.items():
        setattr(element, name, value)
