"""Checks of robot files against their models: every fault is one line that names the cure, all at once."""

import pytest

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import mujoco
from sim_assets.robots import load_robot
from sim_assets.robots.mounting import PREFIX
from sim_assets.robots.named_parts import MIN_FORCE, grip_force
from tests.sim_assets.robots.conftest import SLIDING, linkage

SERVO = '<actuator><position name="grip" joint="left" kp="{kp}" ctrlrange="{range}"/></actuator></mujoco>'
COUPLED = '<equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality></mujoco>'


def actuated(kp=2000, control="-.1 .04"):
    return SLIDING.replace("</mujoco>", SERVO.format(kp=kp, range=control)).replace("</mujoco>", COUPLED)


NAMED = 'actuator = "grip"\nopen = 0.04\nclosed = 0.0\npress = -0.02'


def problems(path):
    with pytest.raises(RobotFileError) as caught:
        load_robot(str(path))
    return caught.value.problems


@pytest.mark.parametrize("mjcf", [SLIDING, linkage(), SLIDING.replace('"left"', '"l/f"'), actuated()])
def test_sound_arms_load_as_they_come(write, mjcf):
    path = write(mjcf)
    path.write_text(path.read_text().replace('"left"', '"l/f"' if "l/f" in mjcf else '"left"'))
    robot = load_robot(str(path))
    assert 0.06 < robot.description.max_width < 0.083
    assert robot.description.joint_names == tuple(PREFIX + n for n in ("turn", "lift", "bend", "roll"))


def test_all_problems_of_a_file_are_listed_at_once(write):
    path = write(arm="base = [0, 0]\nspeed = 1", gripper="force = -3")
    path.write_text(path.read_text().replace("'turn'", "'twist'").replace("jerk = [200, 200, 200, 200]", ""))
    found = problems(path)
    expected = (
        "base has 2 entries",
        "speed is unknown",
        "force = -3 must be above 0",
        "jerk is missing",
        "no joint 'twist'",
    )
    for text in expected:
        assert sum(text in problem for problem in found) == 1, (text, found)
    assert all(str(path) in problem and "\n" not in problem for problem in found)


FAULTS = {
    "slides": (SLIDING.replace('name="turn" axis', 'name="turn" type="slide" axis'), {}, "'turn' must be a hinge with a range"),
    "home": (SLIDING.replace('range="-2.5 2.5"', 'range="-1 1"'), {}, r"home 2 of joint 'bend' is outside its range -1..1 rad"),
    "unlisted": (SLIDING.replace('<joint name="lift"', '<joint name="tilt" axis="1 0 0" range="-1 1"/><joint name="lift"'), {}, "'tilt' moves the arm but is not in [arm] joints: list it"),
    "second arm": (SLIDING.replace("<worldbody>", '<worldbody><body name="b"><joint name="other"/><geom size=".1"/></body>'), {}, 'keep the arm alone with [arm] body = "base"'),
    "motors": (actuated(), {"arm": 'actuators = ["grip", "a", "b", "c"]'}, "the MJCF has no actuator 'a'; it has grip"),
    "open": (actuated(control="-.1 .03"), {"gripper": NAMED}, "open = 0.04 is outside the actuator's ctrlrange -0.1..0.03"),
    "same": (actuated(), {"gripper": NAMED.replace("0.04", "0.0")}, "open and closed are the same command"),
    "weak": (actuated(kp=100), {"gripper": NAMED}, f"too little to hold a can (at least {MIN_FORCE:g} N): raise"),
    "wide": (SLIDING, {"gripper": "max_width = 0.12"}, "the pads open to 0.0820 m: leave it out"),
    "no tcp": (SLIDING, {"gripper": 'tcp = "tip"'}, "no site 'tip'; it has none with a name"),
    "finger range": (SLIDING.replace('axis="0 1 0" range="0 .04"', 'axis="0 1 0" limited="false"'), {}, "finger joint 'left' needs a range"),
    "no body": (SLIDING, {"arm": 'body = "none"'}, "no body 'none' ([arm] body); it has base"),
    "ghost hand": (SLIDING.replace('group="3" type="box" size=".05', 'contype="0" conaffinity="0" type="box" size=".05'), {}, "no collision geom of the hand moves"),
    "camera": (SLIDING, {"more": '[camera]\nsite = { body = "x", position = [0, 0, 0] }'}, "no body 'x', on which the file places a site"),
    "hand file": (SLIDING, {"more": '[hand]\nmjcf = "hand.xml"\nmount = "wrist"'}, "hand.xml: no such MJCF file"),
}  # fmt: skip


@pytest.mark.parametrize(("mjcf", "changes", "message"), FAULTS.values(), ids=FAULTS)
def test_faults_name_the_cure(write, mjcf, changes, message):
    found = problems(write(mjcf, **changes))
    assert any(message in problem for problem in found), found


def test_joints_out_of_order(write):
    path = write()
    path.write_text(path.read_text().replace("['turn', 'lift'", "['lift', 'turn'"))
    assert any("list [arm] joints from base to wrist" in problem for problem in problems(path))


def test_grip_force_by_virtual_work(write):
    """One actuator on the left finger, the right one coupled: each pad gets half of its force."""
    path = write(actuated(), gripper=NAMED)
    robot = load_robot(str(path))
    from dataclasses import replace

    own = replace(robot.description.fingers, joint_names=("left", "right"))
    arm = replace(robot, description=replace(robot.description, fingers=own), gripper_actuator="grip")
    force = grip_force(mujoco.MjModel.from_xml_string(actuated()), arm)
    middle = 0.5 * (own.at(own.widths[0])[0] + own.at(own.widths[-1])[0])
    assert force == pytest.approx(2000 * (middle + 0.02) / 2, rel=0.02)
