"""Tests of motions that begin before the one before ends."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from manipulation.blending import blended, corner_postures
from manipulation.errors import PlanningError
from manipulation.trajectories import PERIOD, JointLimits, concatenate, joint_move

LIMITS = JointLimits(np.full(3, 2.0), np.full(3, 6.0), np.full(3, 400.0))
postures = st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3).map(np.array)


def moves(*waypoints):
    return [joint_move(np.array(a, float), np.array(b, float), LIMITS) for a, b in pairwise(waypoints)]


CORNER = moves((0.0, 0.0, 0.0), (1.5, 0.0, 0.0), (1.5, 1.5, 0.0))


@settings(max_examples=40, deadline=None)
@given(st.lists(postures, min_size=2, max_size=5))
def test_a_blended_motion_keeps_the_limits_and_its_derivatives_are_its_own(waypoints):
    parts = moves(*waypoints)
    whole = blended(parts, LIMITS, lambda around: True)
    assert whole.duration <= concatenate(parts).duration + 1e-9
    np.testing.assert_allclose(whole.positions[[0, -1]], [waypoints[0], waypoints[-1]], atol=1e-9)
    np.testing.assert_array_equal(whole.velocities[-1], 0.0)
    assert (np.abs(whole.velocities) <= LIMITS.velocity + 1e-9).all()
    assert (np.abs(whole.accelerations) <= LIMITS.acceleration + 1e-9).all()
    if len(whole.positions) > 2:
        steps = np.diff(whole.positions, axis=0) / PERIOD
        mean = 0.5 * (whole.velocities[1:] + whole.velocities[:-1])
        np.testing.assert_allclose(steps, mean, atol=LIMITS.jerk.max() * PERIOD**2)


def test_a_corner_between_two_joints_is_cut_without_a_stop():
    whole = blended(CORNER, LIMITS, lambda around: True)
    saved = concatenate(CORNER).duration - whole.duration
    stopping = LIMITS.velocity[0] / LIMITS.acceleration[0]
    assert stopping < saved < stopping + 0.05, "all of the time in which both change their speed"
    speed = np.linalg.norm(whole.velocities, axis=1)
    middle = speed[len(speed) // 4 : -len(speed) // 4]
    assert middle.min() > 0.5 * middle.max(), "it does not stop on the way"
    away = np.linalg.norm(whole.positions - CORNER[0].positions[-1], axis=1).min()
    assert 0.02 < away < 0.3


def test_the_same_joint_is_not_accelerated_beyond_its_limit():
    """There and back: braking and speeding up again add up to twice the acceleration."""
    parts = moves((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    whole = blended(parts, LIMITS, lambda around: True)
    assert np.abs(whole.accelerations).max() <= LIMITS.acceleration[0]


def test_a_corner_that_is_not_free_is_cut_less_or_not_at_all():
    asked = []

    def allows(around):
        asked.append(around)
        away = np.linalg.norm(around.positions - CORNER[0].positions[-1], axis=1).min()
        return away < 0.06

    less = blended(CORNER, LIMITS, allows)
    assert len(asked) > 1 and len(asked[0].positions) > len(asked[-1].positions)
    free = blended(CORNER, LIMITS, lambda around: True)
    stops = blended(CORNER, LIMITS, lambda around: False)
    assert free.duration < less.duration < stops.duration
    np.testing.assert_array_equal(stops.positions, concatenate(CORNER).positions)


def test_what_is_examined_is_what_the_arm_does():
    seen = []
    whole = blended(CORNER, LIMITS, lambda around: seen.append(around) or True)
    rows = [np.abs(whole.positions - q).max(axis=1).min() for q in corner_postures(seen[0])]
    assert max(rows) == 0.0
    np.testing.assert_array_equal(corner_postures(seen[0])[[0, -1]], seen[0].positions[[0, -1]])


def test_motions_that_do_not_meet_are_refused():
    parts = [*moves((0, 0, 0), (1, 0, 0)), *moves((0, 1, 0), (1, 1, 0))]
    with pytest.raises(PlanningError, match="do not meet"):
        blended(parts, LIMITS, lambda around: True)
