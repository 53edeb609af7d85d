from pathlib import Path

import numpy as np
import pytest
import ruckig
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import manipulation
from manipulation.errors import PlanningError
from manipulation.kinematics import Kinematics
from manipulation.trajectories import (
    PERIOD,
    JointLimits,
    MotionConfig,
    concatenate,
    joint_move,
    joint_path,
    line_motion,
    line_postures,
)

CONFIG = MotionConfig()


@pytest.fixture(scope="module")
def limits(arm):
    # Shares of the published limits, as for a robot at work.
    full = JointLimits.of(arm, CONFIG)
    return JointLimits(0.8 * full.velocity, 0.45 * full.acceleration, 0.06 * full.jerk)


def at_1_khz(trajectory):
    """Positions resampled at 1 kHz by cubic Hermite interpolation of the 2 ms samples."""
    q, qd, h = trajectory.positions, trajectory.velocities, trajectory.period
    middle = (q[:-1] + q[1:]) / 2 + h * (qd[:-1] - qd[1:]) / 8
    out = np.empty((2 * len(q) - 1, q.shape[1]))
    out[::2], out[1::2] = q, middle
    return out


def assert_within(trajectory, limits):
    q = at_1_khz(trajectory)
    velocity = np.diff(q, axis=0) / 1e-3
    acceleration = np.diff(velocity, axis=0) / 1e-3
    assert (np.abs(velocity) <= 1.005 * limits.velocity + 1e-4).all()
    assert (np.abs(acceleration) <= 1.02 * limits.acceleration + 0.05).all()
    jerk = np.diff(trajectory.accelerations, axis=0) / trajectory.period
    assert np.isfinite(jerk).all()
    return jerk


postures = st.lists(st.floats(-1.5, 1.5), min_size=7, max_size=7).map(np.array)


@settings(max_examples=25, deadline=None)
@given(start=postures, goal=postures)
def test_joint_moves_keep_all_limits_and_the_straight_line(limits, start, goal):
    move = joint_move(start, goal, limits)
    jerk = assert_within(move, limits)
    assert (np.abs(jerk) <= 1.01 * limits.jerk + 1.0).all()
    assert move.positions[0] == pytest.approx(start) and move.positions[-1] == pytest.approx(goal)
    assert not move.velocities[[0, -1]].any() and not move.accelerations[-1].any()
    step = goal - start
    if np.linalg.norm(step) > 1e-6:
        along = (move.positions - start) @ step / (step @ step)
        assert np.abs(move.positions - start - along[:, None] * step).max() < 1e-9


def test_joint_moves_are_as_fast_as_one_joint_allows(limits):
    goal = np.zeros(7)
    goal[3] = 2.0
    move = joint_move(np.zeros(7), goal, limits)
    assert move.velocities[:, 3].max() == pytest.approx(limits.velocity[3], rel=1e-3)
    assert move.period == PERIOD and move.duration == pytest.approx(PERIOD * (len(move.positions) - 1))


def test_no_move_at_all_is_one_sample(limits):
    assert joint_move(np.ones(7), np.ones(7), limits).duration == 0


@pytest.mark.parametrize(
    ("goal", "message"), [(np.zeros(6), "does not fit 7 joints"), (np.full(7, np.nan), "not finite")]
)
def test_impossible_requests_are_refused(limits, goal, message):
    with pytest.raises(PlanningError, match=message):
        joint_move(np.zeros(len(goal)), goal, limits)


def test_path_rests_in_its_way_points(limits):
    way = [np.zeros(7), np.full(7, 0.3), np.full(7, -0.2)]
    path = joint_path(way, limits)
    resting = np.flatnonzero(np.abs(path.velocities).max(axis=1) == 0)
    assert np.abs(path.positions[resting] - way[1]).max(axis=1).min() < 1e-12
    assert_within(path, limits)
    with pytest.raises(PlanningError, match="two waypoints"):
        joint_path(way[:1], limits)


def test_chained_parts_must_meet(limits):
    first = joint_move(np.zeros(7), np.ones(7), limits)
    with pytest.raises(PlanningError, match="do not meet"):
        concatenate([first, first])


def test_straight_line_stays_straight_upright_and_within_limits(arm, limits):
    kinematics = Kinematics(arm)
    T = kinematics.forward(arm.q_home)
    T_goal = T.copy()
    T_goal[:3, 3] += (0.15, 0.1, -0.25)
    postures = line_postures(kinematics, arm.q_home, T_goal, CONFIG)
    length = float(np.linalg.norm(T_goal[:3, 3] - T[:3, 3]))
    line = line_motion(postures, length, limits, CONFIG)
    assert_within(line, limits)
    poses = np.array([kinematics.forward(q) for q in line.positions[::25]])
    direction = (T_goal[:3, 3] - T[:3, 3]) / length
    offset = poses[:, :3, 3] - T[:3, 3]
    away = offset - (offset @ direction)[:, None] * direction
    assert np.linalg.norm(away, axis=1).max() < 3e-4
    assert poses[:, 2, 2].max() < -0.99999
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / (25 * PERIOD)
    assert speed.max() <= 1.02 * CONFIG.line_speed
    assert poses[-1][:3, 3] == pytest.approx(T_goal[:3, 3], abs=3e-4)


def test_few_solutions_of_the_inverse_kinematics_make_a_line(arm, monkeypatch):
    kinematics, solved = Kinematics(arm), []
    inverse = kinematics.inverse
    monkeypatch.setattr(kinematics, "inverse", lambda T, *a, **k: solved.append(T) or inverse(T, *a, **k))
    T_goal = kinematics.forward(arm.q_home)
    T_goal[2, 3] -= 0.24
    postures = line_postures(kinematics, arm.q_home, T_goal, CONFIG)
    assert len(postures) == 1 + 40, "postures every 6 mm"
    assert len(solved) == 10, "solutions every 24 mm"
    heights = [kinematics.forward(q)[2, 3] for q in postures]
    np.testing.assert_allclose(np.diff(heights), -0.006, atol=2e-4)


def test_solutions_are_closer_where_the_spline_would_leave_the_line(arm):
    kinematics = Kinematics(arm)
    T = kinematics.forward(arm.q_home)
    T_goal = T.copy()
    T_goal[:3, 3] += (0.1, 0.45, -0.3)
    config = MotionConfig(line_step=0.3, max_line_joint_step=2.0)
    postures = line_postures(kinematics, arm.q_home, T_goal, config)
    offset = np.array([kinematics.forward(q)[:3, 3] for q in postures]) - T[:3, 3]
    direction = (T_goal[:3, 3] - T[:3, 3]) / np.linalg.norm(T_goal[:3, 3] - T[:3, 3])
    assert np.linalg.norm(offset - np.outer(offset @ direction, direction), axis=1).max() < 5e-4


def test_a_line_ends_at_the_first_solution_that_is_not_free(arm, monkeypatch):
    kinematics, solved = Kinematics(arm), []
    inverse = kinematics.inverse
    monkeypatch.setattr(kinematics, "inverse", lambda T, *a, **k: solved.append(T) or inverse(T, *a, **k))
    T_goal = kinematics.forward(arm.q_home)
    begin = T_goal[2, 3]
    T_goal[2, 3] -= 0.24
    postures = line_postures(
        kinematics, arm.q_home, T_goal, CONFIG, is_free=lambda q: kinematics.forward(q)[2, 3] > begin - 0.06
    )
    heights = [kinematics.forward(q)[2, 3] - begin for q in postures]
    np.testing.assert_allclose(heights, [0.0, -0.024, -0.048, -0.072], atol=2e-4)
    assert len(solved) == 3


def test_line_is_slowed_down_where_a_joint_would_be_too_fast(arm, limits):
    slow = JointLimits(0.05 * limits.velocity, limits.acceleration, limits.jerk)
    kinematics = Kinematics(arm)
    T_goal = kinematics.forward(arm.q_home)
    T_goal[2, 3] -= 0.2
    postures = line_postures(kinematics, arm.q_home, T_goal, CONFIG)
    line = line_motion(postures, 0.2, slow, CONFIG)
    assert_within(line, slow)
    assert line.duration > line_motion(postures, 0.2, limits, CONFIG).duration


def test_line_out_of_reach_is_none(arm):
    kinematics = Kinematics(arm)
    T_goal = kinematics.forward(arm.q_home)
    T_goal[0, 3] += 1.0
    assert line_postures(kinematics, arm.q_home, T_goal, CONFIG) is None


def test_intermediate_positions_are_never_set(limits, monkeypatch):
    """Ruckig sends paths with intermediate positions to a remote server in plain HTTP."""
    seen = []

    class Watched(ruckig.InputParameter):
        def __setattr__(self, name, value):
            seen.append(name)
            super().__setattr__(name, value)

    monkeypatch.setattr(ruckig, "InputParameter", Watched)
    joint_path([np.zeros(7), np.ones(7), np.zeros(7)], limits)
    assert "target_position" in seen and "intermediate_positions" not in seen
    for source in Path(manipulation.__file__).parent.glob("*.py"):
        assert "intermediate_positions" not in source.read_text(), source


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("quantity", ["velocity", "acceleration", "jerk"])
def test_the_limit_of_each_joint_is_kept_and_reached(quantity, joint):
    """All joints move by 1 rad; one limit of one joint is far below all others and determines the motion."""
    values = {name: np.full(7, 1e3) for name in ("velocity", "acceleration", "jerk")}
    values[quantity][joint] = 2.0
    move = joint_move(np.zeros(7), np.ones(7), JointLimits(**values))
    derivative = {
        "velocity": move.velocities,
        "acceleration": move.accelerations,
        "jerk": np.diff(move.accelerations, axis=0) / PERIOD,
    }[quantity]
    assert np.abs(derivative[:, joint]).max() == pytest.approx(2.0, rel=0.03)


def test_limits_are_scaled_by_the_configuration(arm):
    scaled = JointLimits.of(arm, MotionConfig(velocity_scale=0.5, acceleration_scale=0.25, jerk_scale=0.1))
    np.testing.assert_allclose(scaled.velocity, 0.5 * arm.velocity_limit)
    np.testing.assert_allclose(scaled.acceleration, 0.25 * arm.acceleration_limit)
    np.testing.assert_allclose(scaled.jerk, 0.1 * arm.jerk_limit)


def arc(n=30):
    """Postures of seven joints along a bent path: quadratic in the path parameter."""
    s = np.linspace(0.0, 1.0, n)[:, None]
    return s * np.arange(1, 8) / 10 + 0.3 * s**2


def test_velocities_and_accelerations_of_a_line_are_the_derivatives_of_its_positions(limits):
    line = line_motion(arc(), 0.3, limits, CONFIG)
    velocity = np.gradient(line.positions, PERIOD, axis=0)
    acceleration = np.gradient(line.velocities, PERIOD, axis=0)
    np.testing.assert_allclose(line.velocities[2:-2], velocity[2:-2], atol=2e-3)
    np.testing.assert_allclose(line.accelerations[2:-2], acceleration[2:-2], atol=0.1)


@pytest.mark.parametrize("quantity", ["velocity", "acceleration"])
def test_a_line_is_slowed_down_to_the_limit_of_one_joint(limits, quantity):
    values = {"velocity": limits.velocity.copy(), "acceleration": limits.acceleration.copy()}
    values[quantity][3] *= 0.02
    slow = line_motion(arc(), 0.3, JointLimits(**values, jerk=limits.jerk), CONFIG)
    reached = slow.velocities if quantity == "velocity" else slow.accelerations
    assert 0.8 * values[quantity][3] < np.abs(reached[:, 3]).max() <= values[quantity][3]
    assert slow.duration > line_motion(arc(), 0.3, limits, CONFIG).duration


def test_a_line_with_a_change_of_the_ik_branch_is_rejected(arm):
    kinematics = Kinematics(arm)
    T_goal = kinematics.forward(arm.q_home)
    T_goal[2, 3] -= 0.05
    step = np.abs(np.diff(line_postures(kinematics, arm.q_home, T_goal, CONFIG), axis=0)).max()
    assert line_postures(kinematics, arm.q_home, T_goal, MotionConfig(max_line_joint_step=0.9 * step)) is None
    assert (
        line_postures(kinematics, arm.q_home, T_goal, MotionConfig(max_line_joint_step=1.1 * step))
        is not None
    )


def test_orientation_of_a_line_is_interpolated_along_the_geodesic(arm):
    kinematics = Kinematics(arm)
    T_start = kinematics.forward(arm.q_home)
    T_goal = T_start.copy()
    turn = Rotation.from_rotvec([0, 0, 0.4])
    T_goal[:3, :3] = turn.as_matrix() @ T_start[:3, :3]
    postures = line_postures(kinematics, arm.q_home, T_goal, CONFIG)
    assert len(postures) == 1 + 8, "0.4 rad in steps of at most 0.05 rad"
    middle = kinematics.forward(postures[4])
    half = Rotation.from_rotvec([0, 0, 0.2]).as_matrix() @ T_start[:3, :3]
    np.testing.assert_allclose(middle[:3, :3], half, atol=3e-3)
    np.testing.assert_allclose(middle[:3, 3], T_start[:3, 3], atol=3e-4)
