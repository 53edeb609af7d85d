"""The Schur complement against the whole system, camera as object motion, and a window that mends itself."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.inference.problem import FitState
from perception.rendering.pose import ObjectPose, canonical_from_camera, object_by_camera
from perception.slam.bundle_adjustment import (
    CAMERA,
    JointConfig,
    NormalEquations,
    optimise_jointly,
    solve_by_schur,
)
from perception.slam.keyframes import make_keyframe
from perception.slam.marginal_prior import Memory, View
from perception.slam.pixels import SelectionConfig, label_image, select_pixels


@pytest.mark.parametrize(("objects", "cameras"), [(3, 2), (1, 1), (4, 0)])
def test_schur_solves_the_whole_damped_system(objects, cameras):
    rng = np.random.default_rng(objects)
    c, n = CAMERA * cameras, 25
    size = c + n * objects
    # Rows that touch the cameras and one object each: the objects meet only through the cameras.
    H, g = np.zeros((size, size)), rng.normal(size=size)
    for k in range(objects):
        J = np.zeros((80, size))
        J[:, :c] = rng.normal(size=(80, c))
        J[:, c + n * k : c + n * (k + 1)] = rng.normal(size=(80, n))
        H += J.T @ J
    at = [slice(c + n * k, c + n * (k + 1)) for k in range(objects)]
    equations = NormalEquations(
        H[:c, :c],
        np.stack([H[s, s] for s in at]),
        np.stack([H[s, :c] for s in at]),
        g[:c],
        np.stack([g[s] for s in at]),
    )
    damping = 0.05
    whole = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
    step_c, step_o = solve_by_schur(equations, damping)
    np.testing.assert_allclose(np.concatenate([step_c, step_o.ravel()]), whole, rtol=1e-6, atol=1e-9)


def test_a_camera_motion_looks_like_the_opposite_object_motion(scenes):
    rng = np.random.default_rng(3)
    T = scenes.orbit((0.1, 0, 0), 0.5, 35, 70)
    pose = ObjectPose(
        se3_exp(rng.normal(size=6))[:3, :3], rng.normal(0, 0.1, 3), np.array([0.04, 0.05, 0.06])
    )
    xi = 1e-5 * rng.normal(size=6)
    moved = pose.moved(np.concatenate([object_by_camera(pose, T) @ xi, np.zeros(3)]))
    by_camera = canonical_from_camera(pose, (T @ se3_exp(xi))[None])
    by_object = canonical_from_camera(moved, T[None])
    unmoved = canonical_from_camera(pose, T[None])
    np.testing.assert_allclose(
        by_camera - unmoved, by_object - unmoved, atol=2e-3 * np.abs(by_camera - unmoved).max()
    )


@pytest.fixture(scope="module")
def window(cylinders, scenes):
    """Three keyframes with the truth about their poses, the last two disturbed, and a disturbed map."""
    rng = np.random.default_rng(0)
    truth = [scenes.orbit((0, 0.03, 0.03), 0.55, 42, azimuth) for azimuth in (0, 14, 28)]
    keyframes, planes = [], []
    for number, T in enumerate(truth):
        frame, detections, shown = cylinders.look(T, noise=0.001)
        off = (
            np.zeros(6) if number == 0 else np.concatenate([rng.normal(0, 0.006, 3), rng.normal(0, 0.006, 3)])
        )
        labels = label_image(detections, frame.depth.shape)
        landmark_of = {k + 1: one for k, one in enumerate(shown)}
        keyframes.append(
            make_keyframe(number, frame, T @ se3_exp(off), labels, landmark_of, detections, np.eye(6))
        )
        planes.append(select_pixels(frame, labels, {}, T, cylinders.plane, SelectionConfig()).plane_points)
    world = cylinders.map()
    for one in world.ids:
        landmark = world.landmarks[one]
        pose = landmark.state.pose
        off = ObjectPose(pose.rotation, pose.translation + rng.normal(0, 0.002, 3), pose.scale * 1.03)
        world = world.with_landmarks(landmark.with_state(FitState(off, landmark.state.code)))
    return truth, keyframes, planes, world


@pytest.mark.parametrize("use_plane", [True, False])
def test_a_disturbed_window_is_mended(cylinders, window, use_plane):
    truth, keyframes, planes, world = window
    config = JointConfig(iterations=8, use_plane=use_plane, threads=1)
    result = optimise_jointly(keyframes, world.landmarks, cylinders.decoder, cylinders.plane, planes, config)
    assert result.cost_after < 0.5 * result.cost_before
    np.testing.assert_array_equal(result.keyframes[0].T_world_camera, keyframes[0].T_world_camera)
    for key, before, T in list(zip(result.keyframes, keyframes, truth))[1:]:
        error = np.linalg.norm(key.T_world_camera[:3, 3] - T[:3, 3])
        assert error < 0.004 and error < np.linalg.norm(before.T_world_camera[:3, 3] - T[:3, 3])
    for one, landmark in result.landmarks.items():
        x, y, _ = cylinders.places[one]
        assert np.hypot(*(landmark.state.pose.translation[:2] - (x, y))) < 0.003
        assert landmark.updates == 2


def test_what_is_known_from_elsewhere_holds_objects(cylinders, window):
    _, keyframes, planes, world = window
    args = (cylinders.decoder, cylinders.plane, planes, JointConfig(iterations=4, threads=1))
    free = optimise_jointly(keyframes, world.landmarks, *args)
    known = {one: Memory(1e9 * np.eye(25), np.zeros(25)) for one in world.ids[:1]}
    held = optimise_jointly(keyframes, world.landmarks, *args, known)

    def moved(result, one):
        return np.linalg.norm(result.landmarks[one].state.step_from(world.landmarks[one].state))

    assert moved(held, world.ids[0]) < 0.01 * moved(free, world.ids[0])
    assert moved(held, world.ids[1]) > 0.5 * moved(free, world.ids[1])


def test_cameras_move_no_farther_than_they_are_in_doubt(cylinders, window):
    _, keyframes, planes, world = window
    args = (cylinders.decoder, cylinders.plane, planes, JointConfig(iterations=4, threads=1))

    def moves(sigma):
        sure = [replace(key, covariance=sigma**2 * np.eye(6)) for key in keyframes]
        moved = optimise_jointly(sure, world.landmarks, *args).keyframes
        pairs = zip(moved[1:], keyframes[1:])
        return [np.linalg.norm((a.T_world_camera - b.T_world_camera)[:3, 3]) for a, b in pairs]

    assert max(moves(1e-6)) < 1e-5
    assert min(moves(0.1)) > 0.003  # they were put wrong by about 1 cm


def test_each_view_says_something_and_nobody_less_than_nothing(cylinders, window):
    _, keyframes, planes, world = window
    config = JointConfig(iterations=2, threads=1)
    args = (cylinders.decoder, cylinders.plane, planes)
    result = optimise_jointly(keyframes, world.landmarks, *args, config)
    sure = optimise_jointly(keyframes, world.landmarks, *args, replace(config, camera_sigma=np.full(6, 1e-6)))
    assert set(result.views) == {(k.number, one) for k in keyframes for one in k.landmarks}
    for key, view in result.views.items():
        known = view.information
        spectrum = np.linalg.eigvalsh(known)
        assert spectrum[0] > -1e-6 * spectrum[-1] and spectrum[-1] > 0
        assert np.trace(known[19:22, 19:22]) < np.trace(sure.views[key].information[19:22, 19:22])
        assert view.state is result.landmarks[key[1]].state


def test_a_camera_that_was_known_says_more(cylinders, window):
    _, keyframes, planes, world = window
    keyframes = [replace(keyframes[0], covariance=1e-8 * np.eye(6)), *keyframes[1:]]
    config = JointConfig(iterations=1, threads=1)
    args = (world.landmarks, cylinders.decoder, cylinders.plane, planes)
    views = optimise_jointly(keyframes, *args, config).views
    sure = optimise_jointly(keyframes, *args, replace(config, camera_sigma=np.full(6, 1e-6))).views
    for one in keyframes[0].landmarks:
        held, most = (np.trace(v[0, one].information[19:22, 19:22]) for v in (views, sure))
        assert 0.9 * most < held <= most * (1 + 1e-6)
        later, most = (np.trace(v[1, one].information[19:22, 19:22]) for v in (views, sure))
        assert later < 0.7 * most


def test_a_landmark_that_crept_away_is_pulled_back(cylinders, window):
    _, keyframes, planes, world = window
    one = world.ids[0]
    start = world.landmarks[one].state
    before = start.moved(np.concatenate([np.zeros(19), (0.01, 0.0, 0.0), np.zeros(3)]))
    known = {one: Memory.of([View(before, 1e9 * np.eye(25))], start, 4.0)}
    args = (cylinders.decoder, cylinders.plane, planes, JointConfig(iterations=8, threads=1))
    result = optimise_jointly(keyframes, world.landmarks, *args, known)
    assert np.linalg.norm(result.landmarks[one].state.step_from(before)[19:22]) < 1e-3
