"""Parts named by a robot file: each fault is reported by its own message, a sound arm by none."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from manipulation.robot import ArmDescription, GripperGeometry
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.named_parts import check_parts, compiled
from sim_assets.robots.simulated_arm import SimulatedArm

MJCF = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="link">
      <joint name="turn" axis="0 0 1" range="-1 1" limited="true"/>
      <geom name="tube" group="3" size="0.02"/>
      <site name="tcp"/><site name="eye"/>
      <body name="left"><joint name="left" type="slide" axis="0 1 0" range="0 0.04" limited="true"/>
        <geom name="left_pad" group="3" size="0.01"/></body>
      <body name="right"><joint name="right" type="slide" axis="0 -1 0" range="0 0.04" limited="true"/>
        <geom name="right_pad" group="3" size="0.01"/></body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="turn" kp="100" kv="10"/>
    <position name="grip" joint="left" kp="10" ctrllimited="true" ctrlrange="-0.01 0.04"/>
  </actuator>
</mujoco>
"""
ARM = SimulatedArm(
    description=ArmDescription(
        mjcf="",
        joint_names=("turn",),
        finger_joint_names=("left", "right"),
        tcp_site="tcp",
        camera_site="eye",
        q_home=np.array([0.5]),
        velocity_limit=np.ones(1),
        acceleration_limit=np.ones(1),
        jerk_limit=np.ones(1),
        gripper=GripperGeometry(max_width=0.08),
    ),
    add=lambda spec: None,
    actuators=("servo",),
    gripper_actuator="grip",
    open=0.04,
    closed=0.0,
    press=-0.01,
    fovy=45.0,
)


def check(mjcf=MJCF, **changes):
    described = {key: changes.pop(key) for key in ("q_home", "joint_names", "tcp_site") if key in changes}
    arm = replace(ARM, description=replace(ARM.description, **described), **changes)
    check_parts(Path("arm.toml"), mujoco.MjModel.from_xml_string(mjcf), arm)


def test_a_sound_arm_passes():
    check()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<site name="eye"/>', "", "the MJCF has no site 'eye'; it has tcp$"),
        ('axis="0 0 1" range="-1 1" limited="true"', 'axis="0 0 1"', "joint 'turn' must be a hinge with"),
        ('name="turn" axis="0 0 1"', 'name="turn" type="slide" axis="0 0 1"', "joint 'turn' must be a hinge"),
        ('range="-1 1"', 'range="-1 0.4"', r"home 0.5 of joint 'turn' is outside its range -1\.\.0\.4 rad"),
        ('range="-1 1"', 'range="0.6 1"', r"home 0.5 of joint 'turn' is outside its range 0\.6\.\.1 rad"),
        ('kp="100"', 'kp="0"', "actuator 'servo' is no position servo"),
        ('kp="100" kv="10"', 'kp="100" gear="2"', "actuator 'servo' is no position servo"),
        ('name="servo" joint="turn"', 'name="servo" joint="right"', "position servo .* of joint 'turn'"),
        ('<position name="servo" joint="turn" kp="100" kv="10"/>', '<motor name="servo" joint="turn"/>',
         "actuator 'servo' is no position servo"),
        ('<position name="servo" joint="turn" kp="100" kv="10"/>',
         '<general name="servo" joint="turn" biastype="affine" gainprm="100" biasprm="0 -90 -10"/>',
         "actuator 'servo' is no position servo"),
        ('name="right" type="slide" axis="0 -1 0"', 'name="right" axis="0 -1 0"', "'right' must slide"),
        ('axis="0 -1 0" range="0 0.04"', 'axis="0 -1 0" range="0 0.03"', r"over 0\.\.0\.03 m, expected 0"),
        ('axis="0 1 0" range="0 0.04"', 'axis="0 1 0" range="0.01 0.05"', r"slides over 0\.01\.\.0\.05"),
        ('axis="0 1 0" range="0 0.04"', 'axis="0 1 0" range="-0.01 0.04"', r"slides over -0\.01\.\."),
        ('ctrlrange="-0.01 0.04"', 'ctrlrange="-0.01 0.03"', r"open = 0\.04 is outside .* -0\.01\.\.0\.03"),
        ('ctrlrange="-0.01 0.04"', 'ctrlrange="0 0.04"', r"press = -0\.01 is outside the actuator's"),
        ('<body name="right">', "<body>", "every body of the MJCF needs a name"),
        ('<body name="right">', '<body name="a/b">', "every body of the MJCF needs a name without '/'"),
        ('name="right_pad" group="3"', 'name="right_pad" group="2"', "the finger that joint 'right' moves"),
        ('group="3"', 'group="2"', "no geom of the arm is in group 3"),
    ],
)  # fmt: skip
def test_faults_of_the_mjcf(old, new, message):
    assert old in MJCF
    with pytest.raises(RobotFileError, match=f"arm.toml: .*{message}"):
        check(MJCF.replace(old, new))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_names": ("twist",)}, "no joint 'twist'; it has turn, left, right"),
        ({"tcp_site": "tip"}, "no site 'tip'; it has tcp, eye"),
        ({"actuators": ("motor",)}, "no actuator 'motor'; it has servo, grip"),
        ({"gripper_actuator": "clamp"}, "no actuator 'clamp'"),
        ({"q_home": np.array([-1.5])}, "home -1.5 of joint 'turn'"),
        ({"open": 0.0}, "open and closed are the same command"),
        ({"closed": -0.02}, r"closed = -0\.02 is outside"),
    ],
)
def test_faults_of_the_robot_file(changes, message):
    with pytest.raises(RobotFileError, match=f"arm.toml: .*{message}"):
        check(**changes)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('type="slide" axis="0 1 0" range="0 0.04" limited="true"', 'type="slide" axis="0 1 0"'),
        ('axis="0 1 0" range="0 0.04"', 'axis="0 1 0" range="0.00005 0.03995"'),
        ('name="tube" group="3"', 'name="tube" group="0"'),
        ('<body name="left">', '<body name="left"><body name="tip"><geom group="3" size="0.01"/></body>'),
    ],
)
def test_harmless_variants_pass(old, new):
    """Fingers without a range, within 0.1 mm of it, links without collision shapes, pads on a child body."""
    assert old in MJCF
    check(MJCF.replace(old, new))


def test_an_mjcf_that_does_not_compile_is_named(monkeypatch):
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(size=(-1.0, 0, 0))
    monkeypatch.setattr("sim_assets.robots.named_parts.load", lambda mount: spec)
    mount = SimpleNamespace(mjcf=Path("meshes/arm.xml"))
    with pytest.raises(RobotFileError, match=r"arm\.toml: arm\.xml does not compile: "):
        compiled.__wrapped__(Path("arm.toml"), mount)
