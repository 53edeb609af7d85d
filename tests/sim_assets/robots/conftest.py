"""Small arms with hands whose motion and shape are known in closed form."""

import numpy as np
import pytest

from sim_assets.rendering.headless import mujoco

# Four hinges; a hand along x at 0.5 m whose fingers slide along y. Pads: inner faces at y = +-(q + 0.001),
# x 0.09..0.11, so that the tool frame is at x = 0.1005 + ... of the hand (half of the last 19 mm).
SLIDING = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="base"><geom name="foot" group="3" type="box" size=".05 .05 .05" pos="0 0 .05"/>
    <body name="one" pos="0 0 .2"><joint name="turn" axis="0 0 1" range="-3 3"/>
      <geom group="3" type="capsule" size=".03" fromto="0 0 -.05 0 0 .05"/>
      <body name="two"><joint name="lift" axis="0 1 0" range="-2 2"/>
        <geom group="3" type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
        <body name="three" pos=".3 0 0"><joint name="bend" axis="0 1 0" range="-2.5 2.5"/>
          <geom group="3" type="capsule" size=".03" fromto="0 0 0 .2 0 0"/>
          <body name="wrist" pos=".2 0 0"><joint name="roll" axis="1 0 0" range="-3 3"/>
            <geom name="palm" group="3" type="box" size=".02 .06 .03"/>
            <body name="left"><joint name="left" type="slide" axis="0 1 0" range="0 .04" frictionloss="20"/>
              <geom group="3" type="box" size=".05 .005 .008" pos=".06 .006 0"/></body>
            <body name="right"><joint name="right" type="slide" axis="0 1 0" range="-.04 0"/>
              <geom group="3" type="box" size=".05 .005 .008" pos=".06 -.006 0"/></body>
          </body></body></body></body></body>
  </worldbody>
</mujoco>
"""

# The hand as two parallel cranks of 40 mm: pads move on arcs, kept level by an equality.
CRANKS = """
            <body name="left_crank" pos=".02 .01 0"><joint name="left" axis="0 0 1" range="0 1"/>
              <geom group="3" type="capsule" size=".004" fromto="0 0 0 .04 0 0"/>
              <body name="left_pad" pos=".04 0 0"><joint name="left_level" axis="0 0 1" range="-2 2"/>
                <geom group="3" type="box" size=".015 .004 .008" pos=".02 -.006 0"/></body></body>
            <body name="right_crank" pos=".02 -.01 0"><joint name="right" axis="0 0 -1" range="0 1"/>
              <geom group="3" type="capsule" size=".004" fromto="0 0 0 .04 0 0"/>
              <body name="right_pad" pos=".04 0 0"><joint name="right_level" axis="0 0 -1" range="-2 2"/>
                <geom group="3" type="box" size=".015 .004 .008" pos=".02 .006 0"/></body></body>
"""
# A fixed jaw along x from 0.01 to 0.11 with its face at y = 0, and one that turns about z at (0.01, 0): its
# face is on the ray from there at angle q, 0.1 m long.
ONE_JAW = """
            <geom group="3" type="box" size=".05 .005 .008" pos=".06 -.005 0"/>
            <body name="jaw" pos=".01 0 0"><joint name="jaw" axis="0 0 1" range="0 1.5"/>
              <geom group="3" type="box" size=".05 .005 .008" pos=".05 .005 0"/></body>
"""
_LEVEL = '<joint joint1="{0}_level" joint2="{0}" polycoef="0 -1 0 0 0" solref=".004 1"/>'
JOINTS = ("turn", "lift", "bend", "roll")


def linkage() -> str:
    head, rest = SLIDING.split('            <body name="left">')
    equalities = f"<equality>{_LEVEL.format('left')}{_LEVEL.format('right')}</equality>"
    return (head + CRANKS + rest[rest.index("          </body></body></body>") :]).replace(
        "</mujoco>", equalities + "</mujoco>"
    )


def one_jaw() -> str:
    head, rest = SLIDING.split('            <body name="left">')
    return head + ONE_JAW + rest[rest.index("          </body></body></body>") :]


@pytest.fixture(scope="session")
def jaw_model():
    return mujoco.MjModel.from_xml_string(one_jaw())


@pytest.fixture(scope="session")
def sliding_model():
    return mujoco.MjModel.from_xml_string(SLIDING)


@pytest.fixture(scope="session")
def linkage_model():
    return mujoco.MjModel.from_xml_string(linkage())


@pytest.fixture
def write(tmp_path):
    """Write an arm's MJCF and a robot file beside it; return the path of the robot file."""

    def write_files(mjcf: str = SLIDING, gripper: str = "force = 30", arm: str = "", more: str = ""):
        (tmp_path / "arm.xml").write_text(mjcf)
        home = np.array([0.0, -0.5, 2.0, 0.0]).tolist()
        (tmp_path / "robot.toml").write_text(
            f"""mjcf = "arm.xml"\n[arm]\njoints = {list(JOINTS)}\nhome = {home}\nvelocity = [1, 1, 1, 1]
acceleration = [4, 4, 4, 4]\njerk = [200, 200, 200, 200]\n{arm}
[gripper]\njoints = ["left", "right"]\n{gripper}\n{more}\n"""
        )
        return tmp_path / "robot.toml"

    return write_files
