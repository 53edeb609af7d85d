from dataclasses import replace

import mink
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manipulation.errors import ManipulationError
from manipulation.kinematics import IkConfig, Kinematics


@pytest.fixture(scope="module")
def kinematics(arm):
    return Kinematics(arm)


def top_down(x, y, z, yaw=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = x, y, z
    return T


def test_forward_gives_the_published_check_pose(kinematics, arm):
    T = kinematics.forward(arm.q_home)
    assert T[:3, 3] == pytest.approx([0.3069, 0, 0.4869], abs=1e-4)
    assert T[:3, 2] == pytest.approx([0, 0, -1], abs=1e-9)


def test_camera_looks_along_the_hand(kinematics, arm):
    T_tcp, T_camera = kinematics.forward(arm.q_home), kinematics.forward(arm.q_home, "camera")
    assert T_camera[:3, 2] == pytest.approx(T_tcp[:3, 2], abs=1e-9)
    offset = T_tcp[:3, :3].T @ (T_camera[:3, 3] - T_tcp[:3, 3])
    assert offset == pytest.approx([0.065, 0, 0.052 - 0.1034], abs=1e-9)


@pytest.mark.parametrize("frame", ["tcp", "camera"])
def test_inverse_of_forward_reaches_the_same_pose(kinematics, arm, frame):
    rng = np.random.default_rng(3)
    middle, spread = (kinematics.lower + kinematics.upper) / 2, (kinematics.upper - kinematics.lower) / 2
    for _ in range(15):
        q = middle + rng.uniform(-0.6, 0.6, 7) * spread
        T = kinematics.forward(q, frame)
        result = kinematics.inverse(T, [q + rng.normal(scale=0.2, size=7)], frame)
        assert result.converged
        assert kinematics.forward(result.q, frame) == pytest.approx(T, abs=2e-3)
        assert result.position_error <= 1e-4


def test_work_space_is_reached_from_general_seeds_within_the_joint_margin(kinematics):
    rng = np.random.default_rng(4)
    for _ in range(20):
        radius, azimuth = rng.uniform(0.35, 0.68), rng.uniform(-1.2, 1.2)
        T = top_down(
            radius * np.cos(azimuth), radius * np.sin(azimuth), rng.uniform(0.02, 0.3), rng.uniform(-3, 3)
        )
        result = kinematics.inverse(T, kinematics.seeds_toward(T))
        assert result.converged
        assert kinematics.limit_distance(result.q) >= 0.05 - 1e-5
        assert kinematics.within_limits(result.q, margin=0.049)


def test_unreachable_target_is_a_status_with_the_distance_left(kinematics):
    T = top_down(1.5, 0, 0.1)
    result = kinematics.inverse(T, kinematics.seeds_toward(T, 2))
    assert result.status == "not_converged" and not result.converged
    assert 0.4 < result.position_error < 1.5
    assert np.isfinite(result.q).all()


def test_seeds_turn_the_hand_toward_the_target_wherever_home_points(arm):
    turned = replace(arm, q_home=arm.q_home + np.array([0.8, 0, 0, 0, 0, 0, 0]))
    T = top_down(0.3, 0.4, 0.1)
    for kinematics in (Kinematics(arm), Kinematics(turned)):
        x, y = kinematics.forward(kinematics.seeds_toward(T)[0])[:2, 3]
        assert np.arctan2(y, x) == pytest.approx(np.arctan2(0.4, 0.3), abs=1e-5)


def test_seed_outside_the_limits_is_clipped(kinematics):
    T = top_down(0.5, 0.1, 0.1)
    assert kinematics.inverse(T, [np.full(7, 9.0), *kinematics.seeds_toward(T)]).converged


@pytest.mark.parametrize("bad", [np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1]), np.diag([1.0, 1, -1, 1])])
def test_targets_that_are_no_poses_are_refused_by_name(kinematics, arm, bad):
    with pytest.raises(ManipulationError, match="the pose of mug_3"):
        kinematics.inverse(bad, [arm.q_home], name="mug_3")


def test_no_seed_is_an_error_that_names_the_target(kinematics):
    with pytest.raises(ManipulationError, match=r"no start posture.*can_1"):
        kinematics.inverse(np.eye(4), [], name="can_1")


def test_both_limits_of_every_joint_bound_the_interval(kinematics):
    middle = 0.5 * (kinematics.lower + kinematics.upper)
    assert kinematics.within_limits(middle)
    for joint in range(7):
        for bound, sign in ((kinematics.lower, -1), (kinematics.upper, 1)):
            q = middle.copy()
            q[joint] = bound[joint] - sign * 0.02
            assert kinematics.within_limits(q) and kinematics.within_limits(q, margin=0.019)
            assert not kinematics.within_limits(q, margin=0.021)
            assert kinematics.limit_distance(q) == pytest.approx(0.02)
            q[joint] = bound[joint] + sign * 0.02
            assert not kinematics.within_limits(q)
            assert kinematics.limit_distance(q) == pytest.approx(-0.02)


def test_joint_limits_are_those_of_the_model(kinematics):
    assert kinematics.lower == pytest.approx([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
    assert kinematics.upper == pytest.approx([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])


def test_convergence_needs_position_and_rotation(arm):
    """With no iterations the status is that of the seed: 0.5 mrad and 2 mrad about the TCP."""
    kinematics = Kinematics(arm, IkConfig(max_iterations=0))
    T = kinematics.forward(arm.q_home)
    for angle, status in ((5e-4, "converged"), (2e-3, "not_converged")):
        turned = T.copy()
        turned[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([angle, 0, 0]).as_matrix()
        result = kinematics.inverse(turned, [arm.q_home])
        assert result.status == status and result.rotation_error == pytest.approx(angle, rel=1e-3)
    for shift, status in ((5e-5, "converged"), (2e-4, "not_converged")):
        moved = T.copy()
        moved[0, 3] += shift
        result = kinematics.inverse(moved, [arm.q_home])
        assert result.status == status and result.position_error == pytest.approx(shift, rel=1e-3)


def test_seeds_are_home_toward_the_target_another_wrist_and_random_ones(kinematics, arm):
    T = top_down(0.3, 0.4, 0.1)
    seeds = kinematics.seeds_toward(T)
    assert len(seeds) == 4 and len(kinematics.seeds_toward(T, 2)) == 2
    azimuth = np.arctan2(0.4, 0.3)
    np.testing.assert_allclose(seeds[0], arm.q_home + np.array([azimuth, 0, 0, 0, 0, 0, 0]), atol=1e-5)
    np.testing.assert_allclose(seeds[1] - seeds[0], [0, 0, 0, 0, 0, 0, -np.pi / 2], atol=1e-12)
    assert 0.1 < np.abs(np.stack(seeds[2:]) - seeds[0]).mean() < 1.0
    np.testing.assert_array_equal(seeds[2], kinematics.seeds_toward(T)[2])


def test_self_motion_moves_the_elbow_to_both_sides_and_keeps_the_hand(kinematics):
    T = top_down(0.5, 0.2, 0.1)
    q = kinematics.inverse(T, kinematics.seeds_toward(T)).q
    others = list(kinematics.self_motion(q, step=0.3, count=2))
    assert len(others) == 4
    for other in others:
        assert kinematics.forward(other) == pytest.approx(T, abs=2e-3)
        assert kinematics.within_limits(other, margin=0.049)
    # Along the curve: two to each side, the second twice as far, and the wrist's centre moves with the elbow.
    first_joint = [other[0] - q[0] for other in others]
    assert first_joint[0] * first_joint[1] < 0
    assert np.abs(first_joint[2]) > 1.5 * np.abs(first_joint[0])
    wrist = [kinematics.anchors(other)[4] for other in (q, *others)]
    assert all(np.linalg.norm(there - wrist[0]) > 0.01 for there in wrist[1:])


def test_same_target_and_start_are_solved_once(arm, monkeypatch):
    kinematics, steps = Kinematics(arm), []
    solve = mink.solve_ik
    monkeypatch.setattr(mink, "solve_ik", lambda *a, **k: steps.append(1) or solve(*a, **k))
    T = top_down(0.5, 0.1, 0.2)
    seeds = kinematics.seeds_toward(T)
    first = kinematics.inverse(T, seeds)
    q, solved = first.q.copy(), len(steps)
    first.q[0] += 1.0  # the caller's own
    again = kinematics.inverse(T.copy(), [seed.copy() for seed in seeds])
    assert solved and len(steps) == solved
    assert np.array_equal(again.q, q) and again.iterations == first.iterations
    camera = kinematics.inverse(T, seeds, "camera")  # another frame at the same target
    assert len(steps) > solved and not np.allclose(camera.q, q)
