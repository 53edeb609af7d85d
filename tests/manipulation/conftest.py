"""A small arm for the tests: the chain of the Franka Emika Panda with capsules for links, written inline."""

import numpy as np
import pytest

from manipulation.robot import ArmDescription

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
        finger_joint_names=("finger_left", "finger_right"),
        tcp_site="tcp",
        camera_site="camera",
        q_home=np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4]),
        velocity_limit=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
        acceleration_limit=np.array([15, 7.5, 10, 12.5, 15, 20, 20]),
        jerk_limit=np.array([7500.0, 3750, 5000, 6250, 7500, 10000, 10000]),
    )
