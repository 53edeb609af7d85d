"""What the tests handle: the chain of the Franka Panda with capsules for links, and analytic objects."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from manipulation.footprints import BoxRaster
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.nesting import stack_bowls
from manipulation.packing_problem import PackingConfig, PackingProblem, ShapeCache
from manipulation.robot import ArmDescription, FingerMotion
from manipulation.standing import to_standing
from manipulation.types import Box
from perception.geometry import pose_from_yaw
from perception.types import ObjectEstimate, TriangleMesh

_LINKS = [  # position, quaternion, lower and upper limit of each joint, collision capsule from-to in the link
    ("0 0 .333", "1 0 0 0", -2.8973, 2.8973, "0 0 -.19 0 0 -.02", 0.06),
    ("0 0 0", "1 -1 0 0", -1.7628, 1.7628, "0 -.02 0 0 -.18 0", 0.058),
    ("0 -.316 0", "1 1 0 0", -2.8973, 2.8973, "0 0 -.12 0 0 -.02", 0.056),
    (".0825 0 0", "1 1 0 0", -3.0718, -0.0698, "-.08 .08 0 0 .02 0", 0.052),
    ("-.0825 .384 0", "1 -1 0 0", -2.8973, 2.8973, "0 0 -.26 0 .02 -.1", 0.05),
    ("0 0 0", "1 1 0 0", -0.0175, 3.7525, ".02 0 0 .09 0 0", 0.05),
    (".088 0 0", "1 1 0 0", -2.8973, 2.8973, "0 0 0 0 0 .06", 0.047),
]
_HAND = """
<body name="hand" pos="0 0 .107" quat="0.9238795 0 0 -0.3826834">
  <geom name="palm" group="3" type="box" pos="0 0 .033" size=".0315 .102 .033"/>
  <geom name="camera_body" group="3" type="box" pos=".06 0 .04" size=".015 .045 .012"/>
  <site name="tcp" pos="0 0 .1034"/>
  <site name="camera" pos=".065 0 .052" quat="0.7071068 0 0 0.7071068"/>
  <body name="left" pos="0 0 .0584">
    <joint name="finger_left" type="slide" axis="0 1 0" range="0 .04"/>
    <geom group="3" type="box" pos="0 .0055 .027" size=".0085 .0055 .027"/>
  </body>
  <body name="right" pos="0 0 .0584">
    <joint name="finger_right" type="slide" axis="0 -1 0" range="0 .04"/>
    <geom group="3" type="box" pos="0 -.0055 .027" size=".0085 .0055 .027"/>
  </body>
</body>"""


def _mjcf() -> str:
    body, close = "", ""
    for index, (pos, quat, low, high, capsule, radius) in enumerate(_LINKS, start=1):
        body += f"""<body name="link{index}" pos="{pos}" quat="{quat}">
          <joint name="joint{index}" axis="0 0 1" range="{low} {high}"/>
          <geom group="3" type="capsule" fromto="{capsule}" size="{radius}"/>
          <geom group="2" type="sphere" size=".05" contype="0" conaffinity="0"/>"""
        close += "</body>"
    return f"""<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="base">
      <geom group="3" type="capsule" fromto="0 0 .06 0 0 .14" size=".06"/>
      {body}{_HAND}{close}</body></worldbody></mujoco>"""


@pytest.fixture(scope="session")
def arm() -> ArmDescription:
    return ArmDescription(
        mjcf=_mjcf(),
        joint_names=tuple(f"joint{i}" for i in range(1, 8)),
        fingers=FingerMotion.sliding(("finger_left", "finger_right"), 0.08),
        tcp_site="tcp",
        camera_site="camera",
        q_home=np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4]),
        velocity_limit=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
        acceleration_limit=np.array([15, 7.5, 10, 12.5, 15, 20, 20]),
        jerk_limit=np.array([7500.0, 3750, 5000, 6250, 7500, 10000, 10000]),
    )


def _revolved(profile) -> trimesh.Trimesh:
    mesh = trimesh.creation.revolve(np.array(profile), sections=48)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def cup(radius=0.04, height=0.095, wall=0.004, base=0.006) -> trimesh.Trimesh:
    inner = radius - wall
    return _revolved([(0, 0), (radius, 0), (radius, height), (inner, height), (inner, base), (0, base)])


def mug(radius=0.04, height=0.095, wall=0.004) -> trimesh.Trimesh:
    """A cup with a square handle along +x that reaches 25 mm beyond the body."""
    half = height / 2
    bars = [
        ((0.028, 0.01, 0.008), (radius + 0.011, 0, half + 0.021)),
        ((0.028, 0.01, 0.008), (radius + 0.011, 0, half - 0.021)),
        ((0.008, 0.01, 0.05), (radius + 0.021, 0, half)),
    ]
    boxes = [trimesh.creation.box(size).apply_translation(place) for size, place in bars]
    return trimesh.boolean.union([cup(radius, height, wall), *boxes])


def bowl(radius=0.075, height=0.06, wall=0.004, slope=0.1745) -> trimesh.Trimesh:
    """Straight walls that lean outwards by ``slope``, a flat floor."""
    foot = radius - height * np.tan(slope)
    across = wall / np.cos(slope)
    inner_foot = foot - across + 0.005 * np.tan(slope)
    outline = [
        (0, 0),
        (foot, 0),
        (radius, height),
        (radius - across, height),
        (inner_foot, 0.005),
        (0, 0.005),
    ]
    return _revolved(outline)


def can(radius=0.033, height=0.12) -> trimesh.Trimesh:
    return _revolved([(0, 0), (radius, 0), (radius, height), (0, height)])


def bottle(radius=0.038, height=0.22, neck=0.014) -> trimesh.Trimesh:
    shoulder = [(radius, 0.55 * height), (neck, 0.72 * height)]
    return _revolved([(0, 0), (radius, 0), *shoulder, (neck, height), (0, height)])


def flat_bottle(narrow=0.05, wide=0.09, height=0.2) -> trimesh.Trimesh:
    return trimesh.creation.box((narrow, wide, height)).apply_translation((0, 0, height / 2))


def estimate(number, category, mesh, x=0.45, y=-0.3, yaw=0.0, lift=0.0) -> ObjectEstimate:
    """The object as perception hands it over: frame in the middle of the bounding box, handle along +x."""
    centre = mesh.bounds.mean(axis=0)
    T = pose_from_yaw(yaw, np.array([x, y, lift]))
    T[:3, 3] += T[:3, :3] @ centre
    surface = TriangleMesh(mesh.vertices - centre, mesh.faces)
    return ObjectEstimate(number, category, np.zeros(16), T, np.ones(3), surface)


@pytest.fixture(scope="session")
def shapes() -> SimpleNamespace:
    """Analytic meshes (base on z = 0, axis x = y = 0, in [m]) and ``estimate`` to stand them somewhere."""
    return SimpleNamespace(
        cup=cup, mug=mug, bowl=bowl, can=can, bottle=bottle, flat_bottle=flat_bottle, estimate=estimate
    )


@pytest.fixture(scope="session")
def problem_of(shapes) -> Callable[..., PackingProblem]:
    """The problem of packing objects given as (category, mesh); changes are of the packing configuration."""

    def make(*kinds, box=Box(), grasped=False, **changes) -> PackingProblem:
        items = [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]
        stacks = stack_bowls([item for item in items if item.category == "bowl"])
        grasps = {item.name: grasp_candidates(item, GraspConfig()) for item in items} if grasped else {}
        cell = BoxRaster(box, 0.0).cell
        return PackingProblem(
            {item.name: item for item in items}, stacks, grasps, box, PackingConfig(**changes), GraspConfig(),
            ShapeCache(items, cell), cell,
        )  # fmt: skip

    return make
