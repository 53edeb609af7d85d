"""Free bodies of a cell rest where they were put, or are named."""

import numpy as np
import pytest

from sim_assets.cell.settling import fallen_after_nudge, settle_bodies
from sim_assets.rendering.headless import mujoco

SCENE = """
<mujoco><worldbody>
  <geom type="plane" size="2 2 .1"/>
  <body name="block" pos="{x} 0 .1001" euler="0 {lean} 0"><freejoint name="block"/>
    <geom type="box" size=".02 .02 .1"/></body>
  <body name="ball" pos="{x} 0.5 .0501"><freejoint name="ball"/>
    <geom type="sphere" size=".05" condim="6" friction="1 .01 {rolling}"/></body>
</worldbody><keyframe/></mujoco>
"""


def settled(lean=0.0, rolling=0.01, speed=0.0):
    model = mujoco.MjModel.from_xml_string(SCENE.format(x=0, lean=lean, rolling=rolling))
    data = mujoco.MjData(model)
    data.joint("ball").qvel[0] = speed
    mujoco.mj_forward(model, data)
    return settle_bodies(model, data, ["block", "ball"]), data.time


def test_what_stands_is_watched_for_seconds():
    result, seconds = settled()
    assert result is None and 3.0 <= seconds < 4.0


def test_a_toppled_body_is_named():
    fallen = settled(lean=20)[0]
    assert fallen.name == "block" and fallen.reason.startswith("block fell by ")


def test_what_rolls_on_is_named():
    assert settled(rolling=0.00001, speed=0.3)[0].reason == "ball does not come to rest"


@pytest.mark.parametrize("speed", [0.0, 0.2])
def test_what_rolls_to_rest_is_accepted(speed):
    assert settled(rolling=0.02, speed=speed)[0] is None


def test_a_lying_body_may_roll_about_but_not_rise():
    """A cylinder on its side that turns about the vertical rests as it was put: on its side."""
    scene = """
    <mujoco><worldbody><geom type="plane" size="2 2 .1"/>
      <body name="can" pos="0 0 .0301" euler="90 0 0"><freejoint name="can"/>
        <geom type="cylinder" size=".03 .05" condim="6" friction="1 .01 .02"/></body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(scene)
    data = mujoco.MjData(model)
    data.joint("can").qvel[:] = (0.05, 0, 0, 0, 8.0, 0)  # angular velocity in the frame of the body
    mujoco.mj_forward(model, data)
    before = data.body("can").xmat.reshape(3, 3)[:, 2].copy()
    assert settle_bodies(model, data, ["can"]) is None
    after = data.body("can").xmat.reshape(3, 3)[:, 2]
    assert before @ after < np.cos(np.radians(3)) and abs(after[2]) < 0.05


@pytest.mark.parametrize(("half", "stands"), [(0.02, True), (0.001, False)])
def test_what_balances_falls_when_nudged(half, stands):
    """A block of 20 cm on a foot of 4 cm, and on one of 2 mm, which stands as long as nothing touches it."""
    scene = f"""
    <mujoco><option timestep="0.001"/><worldbody><geom type="plane" size="2 2 .1"/>
      <body name="block" pos="0 0 .1"><freejoint name="block"/>
        <geom type="box" size="{half} {half} .1"/></body>
      <body name="can" pos="0.3 0 .03" euler="90 0 0"><freejoint name="can"/>
        <geom type="cylinder" size=".03 .05" condim="6" friction="1 .01 .001"/></body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(scene)
    data = mujoco.MjData(model)
    names = ["block", "can"]
    assert settle_bodies(model, data, names) is None
    time, before = data.time, data.qpos.copy()
    fallen = fallen_after_nudge(model, data, names)
    assert (fallen is None) if stands else (fallen is not None and fallen.name == "block")
    assert data.time == time and (data.qpos == before).all()
