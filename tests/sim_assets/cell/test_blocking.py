"""An arm behind its command: against a wall, under a load beyond its torque, or holding an object."""

import pytest

from sim_assets.cell.blocking import blocking_reason, touched
from sim_assets.rendering.headless import mujoco

# A lever of 1 m that turns about y, with a servo of 10 Nm; wall and weight are added.
LEVER = """
<mujoco>
  <worldbody>
    <body name="lever"><joint name="turn" axis="0 1 0" range="-90 90"/>
      <geom type="capsule" size=".02" fromto="0 0 0 1 0 0" mass="{mass}"/></body>
    {more}
  </worldbody>
  <actuator><position joint="turn" kp="1000" kv="50" forcerange="-10 10"/></actuator>
</mujoco>
"""
WALL = '<body name="wall" pos=".8 0 -.12"><geom type="box" size=".1 .1 .1"/></body>'
BALL = '<body name="ball" pos=".5 0 .06"><freejoint/><geom size=".04" mass=".2" condim="6"/></body>'


def after(mass, more, command, seconds=0.5):
    model = mujoco.MjModel.from_xml_string(LEVER.format(mass=mass, more=more))
    data = mujoco.MjData(model)
    data.ctrl[0] = command
    while data.time < seconds:
        mujoco.mj_step(model, data)
    return model, data


def test_an_obstacle_is_named_with_the_link():
    reason = blocking_reason(*after(0.1, WALL, 0.5), "turn", 0, "turn")
    assert reason == "the arm is blocked by wall at lever"


def test_a_load_beyond_the_torque_is_no_obstacle():
    reason = blocking_reason(*after(5.0, "", -0.5), "turn", 0, "turn")
    assert reason.startswith("the servo of turn is at its limit of 10 Nm and nothing is in the way")


def test_an_arm_that_follows_is_neither():
    assert blocking_reason(*after(0.1, "", 0.1), "turn", 0, "turn") == "the arm is blocked"


@pytest.mark.parametrize("wall", [False, True])
def test_a_held_object_is_an_obstacle_only_where_it_touches_another_thing(wall):
    beside = '<body name="beside" pos=".5 0 .14"><geom type="box" size=".1 .1 .04"/></body>' if wall else ""
    model, data = after(0.1, BALL + beside, -0.3 if wall else 0.0, 0.15)
    assert touched(model, data, model.body("lever").id) == (["beside at an object"] if wall else [])
