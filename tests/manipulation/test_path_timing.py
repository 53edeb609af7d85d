"""Tests of the timing of curved paths."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from manipulation.path_timing import PathLimits, fastest

PERIOD, WINDOW = 0.002, 0.05
LIMITS = PathLimits(np.array([1.5, 1.5]), np.array([4.0, 8.0]), 10.0, 100.0, WINDOW)


def straight(length):
    s = np.linspace(0, 1, 20)
    return CubicSpline(s, np.stack([length * s, 0.2 * length * s], axis=1))


def bent(angle, length=1.0, corners=40):
    """Two straight halves at an angle, as where one joint reaches its end and others take over."""
    s = np.linspace(0, 1, corners)
    far = np.maximum(s - 0.5, 0.0)
    return CubicSpline(s, length * np.stack([s - (1 - np.cos(angle)) * far, np.sin(angle) * far], axis=1))


def joints(path, motion):
    velocity = path(motion.s, 1) * motion.ds[:, None]
    return velocity, path(motion.s, 1) * motion.dds[:, None] + path(motion.s, 2) * motion.ds[:, None] ** 2


@pytest.mark.parametrize("length, reaches", [(0.2, False), (2.0, True)])
def test_a_straight_path_takes_the_closed_form_time(length, reaches):
    """Bang-bang in acceleration, with a cruise if the speed limit is reached, and the averaging window."""
    motion = fastest(straight(length), LIMITS, PERIOD)
    v, a = LIMITS.velocity[0], LIMITS.acceleration[0]
    expected = length / v + v / a if reaches else 2 * np.sqrt(length / a)
    assert PERIOD * (len(motion.s) - 1) == pytest.approx(expected + WINDOW, rel=0.02, abs=0.004)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=5, max_size=9), st.floats(0.2, 2.0))
def test_a_motion_goes_from_rest_to_rest_and_its_derivatives_are_its_own(values, length):
    s = np.linspace(0, 1, len(values))
    path = CubicSpline(s, np.stack([length * s, 0.3 * np.array(values)], axis=1))
    motion = fastest(path, LIMITS, PERIOD)
    assert (motion.s[0], motion.s[-1]) == (pytest.approx(0, abs=1e-9), 1.0)
    assert (np.diff(motion.s) >= -1e-12).all()
    assert motion.ds[[0, -1]] == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(
        np.gradient(motion.s, PERIOD)[2:-2], motion.ds[2:-2], atol=0.01 * motion.ds.max()
    )
    slope = np.gradient(motion.ds, PERIOD)[2:-2]
    np.testing.assert_allclose(slope, motion.dds[2:-2], atol=0.05 * np.abs(motion.dds).max())
    velocity, acceleration = joints(path, motion)
    assert (np.abs(velocity) <= 1.1 * LIMITS.velocity).all(), "but for what the averaging adds"
    assert (np.abs(acceleration) <= 1.6 * LIMITS.acceleration).all()


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-5])
def test_a_path_of_hardly_any_length_is_no_error(length):
    limits = PathLimits(LIMITS.velocity, LIMITS.acceleration, 8e5, 3e6, WINDOW)
    motion = fastest(straight(length), limits, PERIOD)
    assert (motion.s[0], motion.s[-1]) == (pytest.approx(0, abs=1e-9), 1.0)
    assert (np.diff(motion.s) >= -1e-12).all() and motion.ds[-1] == motion.dds[-1] == 0.0
    assert PERIOD * len(motion.s) < WINDOW + 0.1


def test_a_bend_slows_the_motion_down_only_where_it_is():
    path = bent(0.6)
    motion = fastest(path, LIMITS, PERIOD)
    at_bend = motion.ds[np.abs(motion.s - 0.5).argmin()]
    assert at_bend < 0.5 * motion.ds.max()
    cruise = np.interp([0.25, 0.75], motion.s, motion.ds)
    assert (cruise > 0.75 * motion.ds.max()).all()
    everywhere = PathLimits(LIMITS.velocity, LIMITS.acceleration, at_bend, 100.0, WINDOW)
    assert len(motion.s) < 0.7 * len(fastest(path, everywhere, PERIOD).s)


def test_limits_of_the_path_itself_are_kept():
    limits = PathLimits(LIMITS.velocity, LIMITS.acceleration, 0.5, 1.0, WINDOW)
    motion = fastest(straight(0.5), limits, PERIOD)
    assert motion.ds.max() == pytest.approx(0.5, rel=0.01)
    assert np.abs(motion.dds).max() == pytest.approx(1.0, rel=0.03)


def test_the_acceleration_is_continuous():
    """Without the average it jumps from one bound to the other in a single sample."""
    motion = fastest(straight(0.2), LIMITS, PERIOD)
    jump = np.abs(np.diff(motion.dds)).max()
    assert jump <= 2.2 * np.abs(motion.dds).max() * PERIOD / WINDOW


def test_slower_limits_stretch_the_time():
    fast, slow = (fastest(bent(0.6), limits, PERIOD) for limits in (LIMITS, LIMITS.slower(1.5)))
    assert len(slow.s) * PERIOD - WINDOW == pytest.approx(1.5 * (len(fast.s) * PERIOD - WINDOW), rel=0.01)
