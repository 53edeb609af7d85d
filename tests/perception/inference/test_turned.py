"""Handles of standing mugs that point elsewhere, found by depth."""

import numpy as np
import pytest

from perception.geometry import nearest_yaw, so3_exp
from perception.inference import turned
from perception.inference.handle import body_axis
from perception.inference.refit import refit_pose
from perception.inference.turned import refit_turned
from perception.rendering.pose import ObjectPose
from perception.types import RgbdFrame

AZIMUTHS = (0.3, 1.5, 2.7)


@pytest.fixture(scope="module")
def frames(mug) -> list[RgbdFrame]:
    rng = np.random.default_rng(5)
    return [mug.frame(mug.camera(azimuth), rng)[0] for azimuth in AZIMUTHS]


def expected(mug, estimate, degrees: float) -> np.ndarray:
    """The pose of the mug with its handle turned away from where it is."""
    turn = np.array([0.0, 0.0, np.deg2rad(degrees)])
    return mug.pose.turned(turn, body_axis(estimate)).T_world_object


@pytest.mark.parametrize("degrees", [-136, -50, -24, 24, 50, 180])
def test_a_handle_that_points_elsewhere_is_found(mug, estimate, frames, degrees) -> None:
    T = expected(mug, estimate, degrees)
    near = refit_pose(estimate, frames, T)
    check = refit_turned(estimate, frames, T) or near
    assert check.status == "seen"
    assert nearest_yaw(check.T_world_object) == pytest.approx(0.8, abs=np.deg2rad(9))
    np.testing.assert_allclose(check.T_world_object[:3, 3], mug.pose.translation, atol=0.003)
    if degrees == -50:
        assert abs(nearest_yaw(near.T_world_object) - 0.8) > np.deg2rad(10), "the fit nearby does not find it"


def test_a_handle_where_it_is_expected_is_left(mug, estimate, frames) -> None:
    assert refit_turned(estimate, frames, expected(mug, estimate, 0.0)) is None
    assert refit_turned(estimate, frames, expected(mug, estimate, 5.0)) is None


def test_a_handle_that_depth_shows_nowhere_is_left(mug, estimate, frames, monkeypatch) -> None:
    """However much better the mug agrees when it is turned."""
    T = expected(mug, estimate, -136)
    assert refit_turned(estimate, frames, T) is not None
    monkeypatch.setattr(turned, "shows_handle", lambda estimate, frames, others: False)
    assert refit_turned(estimate, frames, T) is None


def test_a_handle_out_of_view_is_left(mug, estimate) -> None:
    """From one side, with the handle behind the body, no direction of it explains more."""
    rng = np.random.default_rng(5)
    behind = mug.pose.T_world_object[:3, 0]
    azimuth = float(np.arctan2(-behind[1], -behind[0]))
    frame = mug.frame(mug.camera(azimuth), rng)[0]
    T = expected(mug, estimate, 25.0)
    assert refit_turned(estimate, [frame], T) is None


def test_poses_turn_about_the_axis_of_the_body(mug, estimate) -> None:
    T = expected(mug, estimate, 70.0)
    axis = body_axis(estimate)
    np.testing.assert_allclose(
        T[:3, :3] @ axis + T[:3, 3], mug.pose.rotation @ axis + mug.pose.translation, atol=1e-12
    )
    pose = ObjectPose.of(T, mug.pose.scale)
    np.testing.assert_allclose(
        pose.rotation, mug.pose.rotation @ so3_exp(np.array([0, 0, np.deg2rad(70.0)])), atol=1e-12
    )


def test_what_the_network_sees_as_expected_was_not_turned(mug, estimate, frames) -> None:
    """Whatever depth says."""
    T, asked = expected(mug, estimate, -136), []

    def see(at):
        asked.append(at)
        return nearest_yaw(T) + np.deg2rad(25)

    assert refit_turned(estimate, frames, T, see_yaw=see) is None
    # The network is asked about the mug where it stands.
    np.testing.assert_allclose(asked[0].T_world_object[:3, 3], T[:3, 3], atol=0.01)
    assert refit_turned(estimate, frames, T, see_yaw=lambda at: nearest_yaw(T) - 2 * np.pi) is None


@pytest.mark.parametrize("yaw", [None, -2.5, 0.8])
def test_another_direction_that_the_network_sees_is_no_evidence(mug, estimate, frames, yaw) -> None:
    T = expected(mug, estimate, -136)
    alone = refit_turned(estimate, frames, T)
    check = refit_turned(estimate, frames, T, see_yaw=lambda at: yaw)
    np.testing.assert_array_equal(check.T_world_object, alone.T_world_object)


def test_a_handle_that_depth_shows_as_expected_needs_no_network(mug, estimate, frames) -> None:
    def fail(at):
        raise AssertionError

    assert refit_turned(estimate, frames, expected(mug, estimate, 0.0), see_yaw=fail) is None
