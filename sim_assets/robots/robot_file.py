"""Robot files: TOML with the path of an arm's MJCF and what cannot be found out from it.

``sixaxis/robot.toml`` is an example with every entry explained. What a file leaves open is measured on
the model: the hand's shape and motion, servos, the place of the camera.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manipulation.robot import ArmDescription, FingerMotion, GripperGeometry
from perception.errors import InvalidInputError
from perception.io.files import read_text
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel
from sim_assets.robots.finger_motion import hand_joints, sweep_hand
from sim_assets.robots.hand_shape import measure_hand
from sim_assets.robots.hand_surface import HandShape
from sim_assets.robots.mounting import (
    HAND_PREFIX,
    PREFIX,
    Frame,
    HandFile,
    Mount,
    SitePose,
    add_to_scene,
    compiled,
)
from sim_assets.robots.named_parts import (
    WIDTH_TOLERANCE,
    part_problems,
    robot_problems,
    stated_hand_problems,
)
from sim_assets.robots.pedestal import pedestal_of
from sim_assets.robots.planning_model import planning_mjcf
from sim_assets.robots.servos import (
    DEFAULT_FORCE,
    GRIPPER,
    actuators_of,
    gripper_servo,
    is_servo,
    joint_servos,
    tendon_lengths,
)
from sim_assets.robots.simulated_arm import SimulatedArm
from sim_assets.robots.toml_table import MAX_DISTANCE, TomlTable

_TCP, _CAMERA = "nodeslam_tcp", "nodeslam_camera"  # sites that the file does not name
_GEOMETRY = [field.name for field in fields(GripperGeometry) if field.name != "one_jaw"]
_LIMITS = {  # least and largest limits of speed that are taken for ones in rad/s, rad/s^2 and rad/s^3
    "velocity": (0.02, 50.0), "acceleration": (0.05, 1000.0), "jerk": (0.5, 1e5),
}  # fmt: skip
_FOVY = (10.0, 120.0)  # [deg], of lenses without fish-eye distortion
_DEFAULT_FOVY = 45.0  # [deg]
_CAMERA_BEHIND = 0.05  # [m] from the TCP back to an assumed camera
_CAMERA_BESIDE = (0.06, 0.12)  # [m] range of its distance from the hand's axis
IDENTITY = (1.0, 0.0, 0.0, 0.0)  # quaternion


@dataclass(frozen=True)
class RobotEntries:
    """Entries of a robot file, as written there.

    Attributes:
        mount: MJCF files and the sites that the file defines.
        actuators: the joints' servos; empty to use those of the model or add some.
        torque: (n,) largest torques of added servos in [Nm]; None for those of the model.
        home: (n,) home posture in [rad].
        limits: (3, n) of velocity, acceleration and jerk in [rad/s], [rad/s^2], [rad/s^3].
        fingers: names of the driven finger joints.
        actuator: the hand's actuator; empty to add a servo.
        commands: its commands at ``max_width``, closed, and for full force.
        force: force of each finger of an added servo in [N]; None for the default.
        geometry: the dimensions of the hand that the file states, in [m].
        tcp: site of the tool frame; empty to measure it.
        fovy: vertical field of view of the camera in [deg].
    """

    mount: Mount
    actuators: tuple[str, ...]
    torque: Float[np.ndarray, "n"] | None
    home: Float[np.ndarray, "n"]
    limits: Float[np.ndarray, "3 n"]
    fingers: tuple[str, ...]
    actuator: str
    commands: tuple[float, float, float]
    force: float | None
    geometry: dict[str, float]
    tcp: str
    fovy: float


def read_robot(path: Path, shipped: Sequence[str] = ()) -> SimulatedArm:
    """Load the arm that a robot file describes and check it against its models.

    Args:
        path: path of the robot file.
        shipped: names of the shipped arms, for the message about a missing file.

    Raises:
        RobotFileError: entries or parts are missing or invalid; lists all problems.
    """
    problems: list[str] = []
    entries = read_entries(path, _parsed(path, shipped), problems)
    try:
        return build_robot(entries, problems)
    except RobotFileError as error:
        found = [*problems, *(p for p in error.problems if p not in problems)]
        raise RobotFileError([p if str(path) in p else f"{path}: {p}" for p in found]) from None


def read_entries(path: Path, document: dict[str, Any], problems: list[str]) -> RobotEntries:
    """Return the entries of a parsed robot file; add a line to ``problems`` for each that is wrong."""
    top = TomlTable("", document, problems)
    arm, gripper = top.table("arm"), top.table("gripper")
    camera, hand = top.table("camera", optional=True), top.table("hand", optional=True)
    mjcf = top.path("mjcf", path.parent)
    joints = arm.names("joints")
    count = len(joints)
    limits = [arm.limits(name, count, *bounds) for name, bounds in _LIMITS.items()]
    base = Frame(arm.numbers("base", 3, (0.0, 0.0, 0.0), MAX_DISTANCE), about_z(arm.number("base_yaw", 0.0)))
    named = "actuator" in gripper
    closed = gripper.number("closed") if named else 0.0
    commands = (gripper.number("open"), closed, gripper.number("press", closed)) if named else (0.0, 0.0, 0.0)
    fingers = gripper.names("joints", (1, 2))
    tcp, tcp_site = gripper.site("tcp", _TCP) if "tcp" in gripper else ("", None)
    optical, camera_site = camera.site("site", _CAMERA) if "site" in camera else ("", None)
    entries = RobotEntries(
        mount=Mount(
            mjcf=mjcf,
            base=base,
            joints=joints,
            root=arm.text("body", ""),
            hand=_hand_file(hand, path.parent) if "hand" in top else None,
            sites=tuple(site for site in (tcp_site, camera_site) if site is not None),
            camera_site=optical,
        ),
        actuators=arm.names("actuators", (count,), optional=True),
        torque=arm.positive_numbers("torque", count) if "torque" in arm else None,
        home=arm.numbers("home", count),
        limits=np.array(limits),
        fingers=fingers,
        actuator=gripper.text("actuator", ""),
        commands=commands,
        force=None if "force" not in gripper else gripper.positive("force"),
        geometry={name: gripper.positive(name) for name in _GEOMETRY if name in gripper},
        tcp=tcp,
        fovy=camera.between("fovy", *_FOVY, _DEFAULT_FOVY),
    )
    for table in (top, arm, gripper, camera, hand):
        table.refuse_others()
    return entries


def _hand_file(hand: TomlTable, folder: Path) -> HandFile:
    frame = Frame(hand.numbers("position", 3, (0.0, 0.0, 0.0)), hand.quaternion("quaternion"))
    return HandFile(hand.path("mjcf", folder), hand.text("mount"), frame)


def build_robot(entries: RobotEntries, problems: Sequence[str] = ()) -> SimulatedArm:
    """Build the arm from the entries of its file; measure what they leave open.

    Raises:
        RobotFileError: the models do not fit the entries; lists ``problems`` and all that were found.
    """
    model = compiled(entries.mount)
    entries = _with_prefixes(entries, model)
    found = [*problems, *part_problems(model, entries)]
    if found:
        raise RobotFileError(found)
    sweep = sweep_hand(model, entries.mount.joints, entries.fingers)
    hand = measure_hand(model, entries.mount.joints, sweep)
    robot, mount = _assembled(entries, model, hand)
    model = compiled(mount)
    found = [*robot_problems(model, robot), *stated_hand_problems(model, entries, hand)]
    if found:
        raise RobotFileError(found)
    base = mount.base
    pedestal = pedestal_of(model, mount.joints[0], base.position, base.quaternion)
    return _as_in_scenes(robot, planning_mjcf(model, base, pedestal))


def _with_prefixes(entries: RobotEntries, model: MjModel) -> RobotEntries:
    """Return the entries with the names of a hand's own file as they are in the composed model."""
    if entries.mount.hand is None:
        return entries
    known = {model.joint(j).name for j in range(model.njnt)}
    known |= {model.actuator(a).name for a in range(model.nu)} | {
        model.site(s).name for s in range(model.nsite)
    }

    def full(name: str) -> str:
        return HAND_PREFIX + name if name not in known and HAND_PREFIX + name in known else name

    return replace(
        entries,
        fingers=tuple(map(full, entries.fingers)),
        actuator=full(entries.actuator),
        tcp=full(entries.tcp),
    )


def _assembled(entries: RobotEntries, model: MjModel, hand: HandShape) -> tuple[SimulatedArm, Mount]:
    """Return the arm with the names of its own files, and the mount with servos and sites."""
    mount, assumptions = entries.mount, []
    geometry = replace(hand.geometry, **entries.geometry)
    fingers = hand.fingers
    if geometry.max_width < fingers.widths[-1] + WIDTH_TOLERANCE:
        fingers = _rescaled(fingers, geometry.max_width)
    sites = list(mount.sites)
    tcp = entries.tcp
    if not tcp:
        tcp = _TCP
        sites.append(SitePose(_TCP, hand.body, _frame(hand.T_body_tcp)))
        place = ", ".join(f"{1e3 * v:.0f}" for v in hand.T_body_tcp[:3, 3])
        assumptions.append(
            f"the tool frame is at {place} mm in body '{hand.body}', between the pads (measured)"
        )
    optical = mount.camera_site
    if not optical:
        optical = _CAMERA
        sites.append(
            SitePose(_CAMERA, hand.body, _frame(hand.T_body_tcp @ assumed_camera(hand, entries.fovy)))
        )
        assumptions.append("a wrist camera looks along the fingers from beside the hand ([camera] site)")
    mount = replace(mount, sites=tuple(sites), camera_site=optical)
    actuators, servos = _servos(entries, model, assumptions)
    gripper = None
    if entries.actuator:
        opened, closed, press = entries.commands
        share = (fingers.widths - fingers.widths[0]) / np.ptp(fingers.widths)
        command, name = closed + share * (opened - closed), entries.actuator
    else:
        below = hand_joints(model, mount.joints)
        if entries.force is None:
            assumptions.append(f"each finger presses with {DEFAULT_FORCE:g} N ([gripper] force)")
        gripper = gripper_servo(model, fingers, below, entries.force or DEFAULT_FORCE)
        command, name = tendon_lengths(fingers, gripper), GRIPPER
        press = float(command[0] - 1.2 * gripper.force / gripper.gain)
    mount = replace(mount, servos=servos, gripper=gripper)
    robot = SimulatedArm(
        description=ArmDescription(
            mjcf="",
            joint_names=mount.joints,
            fingers=fingers,
            tcp_site=tcp,
            camera_site=optical,
            q_home=entries.home,
            velocity_limit=entries.limits[0],
            acceleration_limit=entries.limits[1],
            jerk_limit=entries.limits[2],
            gripper=geometry,
        ),
        add=functools.partial(add_to_scene, mount, fovy=entries.fovy),
        actuators=actuators,
        gripper_actuator=name,
        commands=command,
        press=press,
        fovy=entries.fovy,
        assumptions=tuple(assumptions),
    )
    return robot, mount


def _servos(entries: RobotEntries, model: MjModel, assumptions: list[str]) -> tuple[tuple[str, ...], tuple]:
    """Return the names of the arm's servos, and those to add: none if the model has one for each joint."""
    if entries.actuators:
        return entries.actuators, ()
    joints = entries.mount.joints
    own = [[a for a in actuators_of(model, [model.joint(name).id]) if is_servo(model, a)] for name in joints]
    if all(len(found) == 1 for found in own) and entries.torque is None:
        return tuple(model.actuator(found[0]).name for found in own), ()
    servos = joint_servos(model, joints, entries.torque)
    torques = ", ".join(f"{servo.torque:.3g}" for servo in servos)
    assumptions.append(f"position servos of {torques} Nm were added to the arm's joints ([arm] torque)")
    return tuple(servo.name for servo in servos), servos


def assumed_camera(hand: HandShape, fovy: float) -> Float[np.ndarray, "4 4"]:
    """Return ``T_tcp_camera`` of a camera beside the hand that looks along the fingers, out of its view."""
    slope = np.tan(np.deg2rad(fovy / 2 + 2))
    ahead = hand.points[(hand.points[:, 2] > -_CAMERA_BEHIND) & (np.abs(hand.points[:, 1]) < 0.03)]
    beside = (ahead[:, 0] + (ahead[:, 2] + _CAMERA_BEHIND) * slope).max(initial=0.0)
    T = np.eye(4)
    T[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # right = y, down = -x of the tool
    T[:3, 3] = np.clip(beside, *_CAMERA_BESIDE), 0.0, -_CAMERA_BEHIND
    return T


def _rescaled(fingers: FingerMotion, max_width: float) -> FingerMotion:
    """Return the motion with openings scaled to a stated largest one."""
    return replace(fingers, widths=fingers.widths * (max_width / fingers.widths[-1]))


def _as_in_scenes(robot: SimulatedArm, mjcf: str) -> SimulatedArm:
    """Return the arm with the names of its parts in scenes."""
    arm = robot.description
    fingers = replace(arm.fingers, joint_names=tuple(PREFIX + name for name in arm.fingers.joint_names))
    return replace(
        robot,
        description=replace(
            arm,
            mjcf=mjcf,
            joint_names=tuple(PREFIX + name for name in arm.joint_names),
            fingers=fingers,
            tcp_site=PREFIX + arm.tcp_site,
            camera_site=PREFIX + arm.camera_site,
        ),
        actuators=tuple(PREFIX + name for name in robot.actuators),
        gripper_actuator=PREFIX + robot.gripper_actuator,
    )


def _parsed(path: Path, shipped: Sequence[str]) -> dict[str, Any]:
    remedy = f"give a robot file (FILE.toml) or one of {', '.join(shipped)}"
    try:
        return tomllib.loads(read_text(path))
    except FileNotFoundError:
        raise RobotFileError(
            f"--robot {path} is no robot file (FILE.toml) and none of {', '.join(shipped)}"
        ) from None
    except InvalidInputError as error:
        raise RobotFileError(f"--robot {error}: {remedy}") from None
    except OSError as error:
        raise RobotFileError(f"--robot {path} cannot be read ({error.strerror}): {remedy}") from None
    except (ValueError, RecursionError) as error:  # TOML, UTF-8, integers of thousands of digits, depth
        raise RobotFileError(f"{path} cannot be read as TOML: {error}") from None


def _frame(T: Float[np.ndarray, "4 4"]) -> Frame:
    return Frame(T[:3, 3].copy(), Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True))


def about_z(angle: float) -> np.ndarray:
    """Return the quaternion wxyz of a rotation about z by an angle in [rad]."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
