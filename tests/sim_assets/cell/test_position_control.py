"""Position commands at a fixed rate: joints follow, fingers close at their speed, commands are limited."""

import numpy as np
import pytest

from sim_assets.cell.config import CellConfig
from sim_assets.cell.position_control import PositionControl, _hermite
from sim_assets.cell.world import FINGER_SPEED, World
from sim_assets.errors import SimAssetsError


@pytest.fixture(scope="module")
def world():
    with World(CellConfig(objects=(), box=None)) as world:
        yield world


@pytest.fixture
def control(world):
    control = PositionControl(world, 20.0)
    for _ in range(20):
        control.advance(np.asarray(world.arm.q_home), world.arm.max_width)
    return control


def test_the_period_is_a_multiple_of_the_time_step(world, control):
    assert control.period == pytest.approx(0.05)
    before = world.time
    control.advance(control.q, 0.08)
    assert world.time - before == pytest.approx(0.05)
    control.hold()
    assert world.time - before == pytest.approx(0.10)
    assert PositionControl(world, 300.0).period == pytest.approx(0.004)


@pytest.mark.parametrize("rate", [0.0, -1.0, 501.0, float("nan")])
def test_impossible_rates(world, rate):
    with pytest.raises(SimAssetsError, match="control rate"):
        PositionControl(world, rate)


def test_joints_follow_a_moving_target(world, control):
    """Without the feedforward of velocity the lag would be kv/kp times 0.4 rad/s = 40 mrad."""
    target = control.q.copy()
    for _ in range(10):
        target[0] += 0.02
        control.advance(target, 0.08)
    assert abs(world.joint_positions()[0] - target[0]) < 3e-3


def test_the_command_is_continuous_in_position_and_velocity():
    """Hermite's conditions, and its derivatives by finite differences."""
    s = np.linspace(0, 1, 2001)
    position, velocity, acceleration = _hermite(s)
    np.testing.assert_allclose(position[[0, -1]], [[0, 0, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(velocity[[0, -1]], [[0, 1, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(np.gradient(position, s, axis=0)[1:-1], velocity[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(velocity, s, axis=0)[1:-1], acceleration[1:-1], atol=1e-5)


def test_commands_keep_the_limits_of_speed_and_position(world, control):
    far = control.q + 10.0
    np.testing.assert_allclose(
        control.reachable(far) - control.q,
        np.minimum(np.asarray(world.arm.velocity_limit) * control.period, control.upper - control.q),
    )


def test_fingers_close_at_their_speed_and_open_from_the_measured_width(world, control):
    control.advance(control.q, 0.0)
    lost = world.arm.max_width - world.gripper_width()
    assert 0 < lost < 2 * FINGER_SPEED * control.period + 1e-3
    for _ in range(15):
        control.advance(control.q, 0.0)
    assert world.gripper_width() < 2e-3
    for _ in range(15):
        control.advance(control.q, world.arm.max_width)
    assert world.gripper_width() == pytest.approx(world.arm.max_width, abs=2e-3)


def test_commands_that_are_not_finite_are_refused(world, control):
    before = world.time
    for q, width in ((control.q * np.nan, 0.08), (control.q, np.inf)):
        with pytest.raises(SimAssetsError, match="not finite"):
            control.advance(q, width)
    assert world.time == before


def test_measurements(world, control):
    site = world._data.site(world.arm.tcp_site)
    np.testing.assert_array_equal(control.tcp_position(), site.xpos)
    assert control.joint_velocities().shape == control.q.shape
