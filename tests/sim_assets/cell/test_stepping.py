"""Advancing the physics: by the time asked for, and with a word when it diverges."""

import numpy as np
import pytest

from sim_assets.cell.scene import TIMESTEP
from sim_assets.cell.stepping import SimulationError, advance
from sim_assets.rendering.headless import mujoco

SCENE = f"""
<mujoco><option timestep="{TIMESTEP}"/><worldbody>
  <body pos="0 0 2"><freejoint/><geom size=".05"/></body>
</worldbody></mujoco>
"""


@pytest.fixture
def falling():
    model = mujoco.MjModel.from_xml_string(SCENE)
    return model, mujoco.MjData(model)


def test_a_ball_falls_for_the_time_asked_for(falling):
    model, data = falling
    advance(model, data, 0.3)
    assert data.time == pytest.approx(0.3)
    assert data.qvel[2] == pytest.approx(-9.81 * 0.3)


def test_divergence_is_not_silent(falling):
    model, data = falling
    data.qvel[-1] = np.nan
    with pytest.raises(SimulationError, match="the physics diverged"):
        advance(model, data, 0.1)
