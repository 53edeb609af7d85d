"""Group axioms of SO(3) and SE(3), sampled near the identity and near half a turn on purpose."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from perception import geometry

_components = st.floats(-1, 1, allow_nan=False, width=32)
_directions = st.tuples(_components, _components, _components).map(np.array).filter(lambda v: v @ v > 1e-3)
_angles = st.one_of(
    st.floats(0, np.pi), st.floats(0, 1e-6), st.floats(9e-5, 1.1e-4), st.floats(np.pi - 1e-5, np.pi)
)
rotations = st.builds(lambda d, a: d / np.linalg.norm(d) * a, _directions, _angles)
twists = st.builds(lambda w, d: np.concatenate([w, d]), rotations, _directions)
fast = settings(max_examples=60, deadline=None)


@fast
@given(rotations)
def test_exp_is_a_rotation(omega: np.ndarray) -> None:
    R = geometry.so3_exp(omega)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R @ omega, omega, atol=1e-12)


@fast
@given(rotations)
@example(np.array([0.0, 2.22144101, 2.22144101]))  # half a turn but for 5e-7
def test_so3_exp_undoes_log(omega: np.ndarray) -> None:
    R = geometry.so3_exp(omega)
    np.testing.assert_allclose(geometry.so3_exp(geometry.so3_log(R)), R, atol=1e-7)
    assert np.linalg.norm(geometry.so3_log(R)) <= np.pi + 1e-9


@fast
@given(twists)
def test_se3_log_undoes_exp(xi: np.ndarray) -> None:
    T = geometry.se3_exp(xi)
    np.testing.assert_allclose(geometry.se3_exp(geometry.se3_log(T)), T, atol=1e-6)


@fast
@given(twists, twists, twists)
def test_group_axioms(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    A, B, C = (geometry.se3_exp(x) for x in (a, b, c))
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-12)
    np.testing.assert_allclose(A @ geometry.invert(A), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(geometry.se3_exp(-a), geometry.invert(A), atol=1e-9)


@fast
@given(_directions, _directions)
def test_hat_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(geometry.hat(a) @ b, np.cross(a, b), atol=1e-14)


@fast
@given(_directions, st.floats(-np.pi, np.pi))
def test_upright_rotation_points_z_along_the_normal(normal: np.ndarray, yaw: float) -> None:
    R = geometry.upright_rotation(normal, yaw)
    np.testing.assert_allclose(R[:, 2], normal / np.linalg.norm(normal), atol=1e-9)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_yaw_is_read_back() -> None:
    R = geometry.upright_rotation(np.array([0.0, 0.0, 1.0]), 2.0)
    assert abs(geometry.yaw_of(R) - 2.0) < 1e-12


def test_points_move_as_the_matrix_says() -> None:
    T = geometry.rigid(geometry.so3_exp(np.array([0, 0, np.pi / 2])), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(geometry.transform_points(T, np.array([[1.0, 0.0, 0.0]])), [[1.0, 3.0, 3.0]])


def test_pose_from_yaw_turns_counterclockwise_about_z_and_then_translates() -> None:
    T = geometry.pose_from_yaw(np.pi / 6, np.array([1.0, 2.0, 3.0]))
    expected = [[3**0.5 / 2, -0.5, 0, 1], [0.5, 3**0.5 / 2, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(T, expected, atol=1e-15)


def test_a_levelled_pose_has_the_yaw_and_place_without_the_tilt() -> None:
    """With R = R(tilt about any horizontal axis) R(yaw), the nearest rotation about z is R(yaw)."""
    upright = geometry.pose_from_yaw(0.4, np.array([0.5, 0.2, 0.1]))
    tilted = upright.copy()
    tilted[:3, :3] = geometry.so3_exp(0.3 * np.array([0.6, -0.8, 0.0])) @ upright[:3, :3]
    assert abs(geometry.nearest_yaw(tilted) - 0.4) < 1e-12
    np.testing.assert_allclose(geometry.levelled(tilted, 0.1), upright, atol=1e-12)
    np.testing.assert_allclose(geometry.levelled(tilted, 0.033)[:3, 3], (0.5, 0.2, 0.033))


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.5, 0.5), (-0.5, -0.5), (4.0, 4.0 - 2 * np.pi), (-4.0, 2 * np.pi - 4.0), (7.0, 7.0 - 2 * np.pi)],
)
def test_angles_are_wrapped(angle, wrapped):
    assert geometry.wrapped_angle(angle) == pytest.approx(wrapped, abs=1e-12)


def test_half_a_turn_is_wrapped_to_the_lower_end():
    assert geometry.wrapped_angle(np.pi) == geometry.wrapped_angle(-np.pi) == -np.pi
