"""A 7-joint arm with a parallel gripper and a wrist camera, from the published figures of the Franka Panda.

Frames: the base is the world origin, z up. The TCP lies between the finger pads, z out of the hand, y the
closing direction. The wrist camera's optical frame follows OpenCV (x right, y down, z forward); it looks
along the hand's z, with the hand's x up in the image, so that the closed fingers are out of view.

Geometry: modified (Craig) Denavit-Hartenberg parameters, written as nested bodies. Collision shapes are
capsules (boxes for the finger pads) in group 3; the visual shell is in ``panda_visuals``.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from manipulation.robot import ArmDescription, FingerMotion, GripperGeometry
from sim_assets.rendering.headless import MjsBody, MjSpec, mujoco
from sim_assets.robots.simulated_arm import ARM_CONTACT, PAD_CONTACT, WRIST_CAMERA

ARM_JOINTS = tuple(f"joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("finger_joint1", "finger_joint2")
TCP_SITE = "tcp"
CAMERA_SITE = "camera_optical"
WRIST_FOVY = 45.0  # [deg], MuJoCo's unit
GRIPPER_ACTUATOR = "gripper"
COLLISION_GROUP = 3
VISUAL_GROUP = 2

Q_READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
MAX_WIDTH = 0.08  # [m] between the pads
FINGER_FORCE = 70.0  # [N], force of each finger
TCP_BELOW_HAND = 0.1034  # [m] along the hand's z
CAMERA_IN_HAND = (0.065, 0.0, 0.052)

# Position servo gains; velocity gain = position gain / 10.
POSITION_GAINS = np.array([4500.0, 4500, 3500, 3500, 2000, 2000, 2000])
VELOCITY_GAINS = POSITION_GAINS / 10
GRIPPER_GAIN = 2000.0  # [N/m] on the mean finger opening
FULL_CLOSE = -0.1  # [m], unreachable command: the fingers press with full force

# Published limits and the fractions in use: joint 6 exerts at most 80 % of its torque in 99.9 % of a task.
_VELOCITY = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
_ACCELERATION = np.array([15, 7.5, 10, 12.5, 15, 20, 20])
_JERK = np.array([7500.0, 3750, 5000, 6250, 7500, 10000, 10000])
_VELOCITY_SHARE, _ACCELERATION_SHARE, _JERK_SHARE = 0.9, 0.65, 0.1


@dataclass(frozen=True)
class Capsule:
    """A collision capsule in a body frame: the segment ``start`` to ``end`` swept with ``radius``, in [m]."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class Link:
    """A rigid link: pose in its parent, joint, inertia and collision capsules.

    Attributes:
        position, quaternion: in the parent link; the quaternion (wxyz) is normalised by MuJoCo.
        q_range: joint limits in [rad].
        torque: joint torque limit in [Nm].
        mass: mass in [kg].
        center: centre of mass in [m].
        inertia: (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about the centre of mass in [kg m^2].
        capsules: collision shape.
    """

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    q_range: tuple[float, float]
    torque: float
    mass: float
    center: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]
    capsules: tuple[Capsule, ...]


_I, _MINUS_X, _PLUS_X = (1.0, 0.0, 0.0, 0.0), (1.0, -1.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0)  # rotations about x

BASE_CAPSULES = (Capsule((-0.07, 0, 0.06), (0, 0, 0.06), 0.062), Capsule((0, 0, 0.06), (0, 0, 0.11), 0.062))

LINKS = (
    Link(
        (0, 0, 0.333), _I, (-2.8973, 2.8973), 87, 4.970684, (0.003875, 0.002081, -0.04762),
        (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169),
        (Capsule((0, 0, -0.15), (0, 0, -0.03), 0.06),),
    ),
    Link(
        (0, 0, 0), _MINUS_X, (-1.7628, 1.7628), 87, 0.646926, (-0.003141, -0.02872, 0.003495),
        (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704),
        (Capsule((0, 0, -0.018), (0, 0, 0.018), 0.062), Capsule((0, -0.03, 0), (0, -0.145, 0), 0.058)),
    ),
    Link(
        (0, -0.316, 0), _PLUS_X, (-2.8973, 2.8973), 87, 3.228604, (0.027518, 0.039252, -0.066502),
        (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805),
        (Capsule((0, 0, -0.12), (0.01, 0, -0.07), 0.057), Capsule((0.08, -0.02, 0), (0.08, 0.02, 0), 0.056)),
    ),
    Link(
        (0.0825, 0, 0), _PLUS_X, (-3.0718, -0.0698), 87, 3.587895, (-0.05317, 0.104419, 0.027454),
        (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641),
        (Capsule((0, 0, -0.015), (0, 0, 0.015), 0.054), Capsule((-0.07, 0.07, 0), (-0.08, 0.11, 0), 0.057)),
    ),
    Link(
        (-0.0825, 0.384, 0), _MINUS_X, (-2.8973, 2.8973), 12, 1.225946, (-0.011953, 0.041065, -0.038437),
        (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229),
        (Capsule((0, 0, -0.24), (0, 0, -0.12), 0.056), Capsule((0, 0, -0.12), (0, 0, 0), 0.052)),
    ),
    Link(
        (0, 0, 0), _PLUS_X, (-0.0175, 3.7525), 12, 1.666555, (0.060149, -0.014117, -0.010517),
        (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341),
        (Capsule((0, 0, -0.015), (0, 0, 0.015), 0.05), Capsule((0.083, 0.012, 0), (0.088, -0.012, 0), 0.05)),
    ),
    Link(
        (0.088, 0, 0), _PLUS_X, (-2.8973, 2.8973), 12, 0.735522, (0.010517, -0.004252, 0.061597),
        (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741),
        (Capsule((0, 0, 0.05), (0, 0, 0.075), 0.047),),
    ),
)  # fmt: skip

HAND_CAPSULES = (
    Capsule((0, -0.07, 0.033), (0, 0.07, 0.033), 0.033),
    Capsule((0.062, -0.034, 0.038), (0.062, 0.034, 0.038), 0.0145),  # camera body
)
# Boxes in a finger frame (centre, half size); the pad's inner face is the plane y = 0.
FINGER_STEM_BOX = ((0.0, 0.0105, 0.018), (0.0095, 0.008, 0.018))
FINGER_PAD_BOX = ((0.0, 0.005, 0.0445), (0.0085, 0.005, 0.0092))


def add_arm(spec: MjSpec) -> None:
    """Add the arm to a specification whose angles are in radians, its base at the world's origin."""
    base = spec.worldbody.add_body(name="link0", mass=0.629769, ipos=(-0.041018, -0.00014, 0.049974))
    base.fullinertia = (0.00315, 0.00388, 0.004285, 8.29e-7, 0.00015, 8.23e-6)
    base.explicitinertial = True
    _add_capsules(base, BASE_CAPSULES)
    body = base
    for number, link in enumerate(LINKS, start=1):
        body = _add_link(spec, body, number, link)
    _add_hand(spec, body)


@functools.cache
def arm_description() -> ArmDescription:
    """Return kinematics, collision shapes and limits of the arm, without visual geoms."""
    spec = mujoco.MjSpec()
    spec.modelname = "arm"
    spec.compiler.degree = False
    add_arm(spec)
    spec.compile()
    return ArmDescription(
        mjcf=spec.to_xml(),
        joint_names=ARM_JOINTS,
        fingers=FingerMotion.sliding(FINGER_JOINTS, MAX_WIDTH),
        tcp_site=TCP_SITE,
        camera_site=CAMERA_SITE,
        q_home=Q_READY.copy(),
        velocity_limit=_VELOCITY_SHARE * _VELOCITY,
        acceleration_limit=_ACCELERATION_SHARE * _ACCELERATION,
        jerk_limit=_JERK_SHARE * _JERK,
        gripper=GripperGeometry(max_width=MAX_WIDTH),
    )


def _add_capsules(body: MjsBody, capsules: tuple[Capsule, ...]) -> None:
    for index, capsule in enumerate(capsules):
        body.add_geom(
            name=f"{body.name}_collision{index}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=(*capsule.start, *capsule.end),
            size=(capsule.radius, 0, 0),
            **_COLLISION,
        )


_COLLISION = {"group": COLLISION_GROUP, "mass": 0, "rgba": (0.9, 0.5, 0.2, 0.4), **ARM_CONTACT}


def _add_link(spec: MjSpec, parent: MjsBody, number: int, link: Link) -> MjsBody:
    body = parent.add_body(
        name=f"link{number}",
        pos=link.position,
        quat=link.quaternion,
        gravcomp=1,
        mass=link.mass,
        ipos=link.center,
    )
    body.fullinertia = link.inertia
    body.explicitinertial = True
    joint = f"joint{number}"
    body.add_joint(
        name=joint, axis=(0, 0, 1), range=link.q_range, limited=True, armature=0.1, damping=[1.0, 0, 0]
    )
    _add_capsules(body, link.capsules)
    actuator = spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT,
        ctrlrange=link.q_range, forcerange=(-link.torque, link.torque),
    )  # fmt: skip
    actuator.set_to_position(kp=POSITION_GAINS[number - 1], kv=VELOCITY_GAINS[number - 1])
    return body


def _add_hand(spec: MjSpec, link7: MjsBody) -> None:
    half = np.pi / 8  # the hand is mounted turned by -45 degrees about z
    hand = link7.add_body(
        name="hand", pos=(0, 0, 0.107), quat=(np.cos(half), 0, 0, -np.sin(half)), gravcomp=1,
        mass=0.73, ipos=(-0.01, 0, 0.03), inertia=(0.001, 0.0025, 0.0017), explicitinertial=True,
    )  # fmt: skip
    _add_capsules(hand, HAND_CAPSULES)
    hand.add_site(name=TCP_SITE, pos=(0, 0, TCP_BELOW_HAND), group=4, size=(0.004, 0.004, 0.004))
    optical = hand.add_site(name=CAMERA_SITE, pos=CAMERA_IN_HAND, group=4, size=(0.004, 0.004, 0.004))
    optical.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
    optical.alt.xyaxes = (0, 1, 0, -1, 0, 0)  # OpenCV: x right = hand y, y down = -hand x
    camera = hand.add_camera(name=WRIST_CAMERA, pos=CAMERA_IN_HAND, fovy=WRIST_FOVY)
    camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
    camera.alt.xyaxes = (0, 1, 0, 1, 0, 0)  # the same camera in MuJoCo's axes: y up
    for side, joint, turn in (
        ("left", FINGER_JOINTS[0], _I),
        ("right", FINGER_JOINTS[1], (0.0, 0.0, 0.0, 1.0)),
    ):
        _add_finger(hand, side, joint, turn)
    _couple_fingers(spec)


def _add_finger(hand: MjsBody, side: str, joint: str, turn: tuple[float, ...]) -> None:
    """Add a finger that slides outwards along its own +y over half the opening."""
    finger = hand.add_body(
        name=f"{side}_finger", pos=(0, 0, 0.0584), quat=turn, gravcomp=1,
        mass=0.015, ipos=(0, 0, 0), inertia=(2.375e-6, 2.375e-6, 7.5e-7), explicitinertial=True,
    )  # fmt: skip
    finger.add_joint(
        name=joint, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 1, 0), range=(0, MAX_WIDTH / 2), limited=True,
        armature=0.1, damping=[10.0, 0, 0],
    )  # fmt: skip
    box = mujoco.mjtGeom.mjGEOM_BOX
    center, half = FINGER_STEM_BOX
    finger.add_geom(name=f"{side}_finger_collision0", type=box, pos=center, size=half, **_COLLISION)
    center, half = FINGER_PAD_BOX
    finger.add_geom(name=f"{side}_pad", type=box, pos=center, size=half, **_COLLISION, **PAD_CONTACT)


def _couple_fingers(spec: MjSpec) -> None:
    """Couple both fingers and drive them by a tendon of their mean opening."""
    equality = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=FINGER_JOINTS[0], name2=FINGER_JOINTS[1],
        solref=(0.005, 1), solimp=(0.95, 0.99, 0.001, 0.5, 2),
    )  # fmt: skip
    equality.data[:5] = (0, 1, 0, 0, 0)
    tendon = spec.add_tendon(name="fingers")
    for joint in FINGER_JOINTS:
        tendon.wrap_joint(joint, 0.5)
    force = 2 * FINGER_FORCE  # each finger gets half of the tendon's force
    actuator = spec.add_actuator(
        name=GRIPPER_ACTUATOR, target="fingers", trntype=mujoco.mjtTrn.mjTRN_TENDON,
        ctrlrange=(FULL_CLOSE, MAX_WIDTH / 2), forcerange=(-force, force),
    )  # fmt: skip
    actuator.set_to_position(kp=GRIPPER_GAIN, kv=40.0)
