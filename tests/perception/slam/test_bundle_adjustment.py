"""Joint optimisation of a disturbed window, its priors, and the information of its views."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.inference.problem import FitState, StepLimits
from perception.rendering.pose import ObjectPose, canonical_from_camera, object_by_camera
from perception.slam.bundle_adjustment import _Optimiser, optimise_jointly
from perception.slam.bundle_window import BundleAdjustmentConfig, BundleWindow
from perception.slam.keyframes import Keyframe
from perception.slam.marginal_prior import MarginalPrior, ViewInformation
from perception.slam.pixels import select_pixels

POSITION = slice(19, 22)  # of the object's parameters


def test_a_camera_motion_renders_like_the_opposite_object_motion(scenes):
    rng = np.random.default_rng(3)
    T = scenes.orbit((0.1, 0, 0), 0.5, 35, 70)
    rotation = se3_exp(rng.normal(size=6))[:3, :3]
    pose = ObjectPose(rotation, rng.normal(0, 0.1, 3), np.array([0.04, 0.05, 0.06]))
    xi = 1e-5 * rng.normal(size=6)
    moved = pose.moved(np.concatenate([object_by_camera(pose, T) @ xi, np.zeros(3)]))
    unmoved = canonical_from_camera(pose, T[None])
    by_camera = canonical_from_camera(pose, (T @ se3_exp(xi))[None]) - unmoved
    by_object = canonical_from_camera(moved, T[None]) - unmoved
    np.testing.assert_allclose(by_camera, by_object, atol=2e-3 * np.abs(by_camera).max())


@pytest.fixture(scope="module")
def truth(scenes):
    """True poses of three cameras."""
    return [scenes.orbit((0, 0.03, 0.03), 0.55, 42, azimuth) for azimuth in (0, 14, 28)]


@pytest.fixture(scope="module")
def window(cylinders, observe, truth):
    """Three keyframes, the last two with disturbed poses, and a disturbed map."""
    rng = np.random.default_rng(0)
    keyframes, plane_points = [], []
    for number, T in enumerate(truth):
        view = observe(T, number)
        error = rng.normal(0, 0.006, 6) if number else np.zeros(6)
        keyframes.append(Keyframe.of(view.with_pose(T @ se3_exp(error)), np.eye(6)))
        plane_points.append(select_pixels(view, cylinders.plane).plane_points)
    world = cylinders.map()
    for id in world.ids:
        landmark = world.landmarks[id]
        pose = landmark.state.pose
        pose = ObjectPose(pose.rotation, pose.translation + rng.normal(0, 0.002, 3), pose.scale * 1.03)
        world = world.with_landmarks(landmark.with_state(FitState(pose, landmark.state.code)))
    return BundleWindow(keyframes, world.landmarks, cylinders.plane, plane_points)


def optimised(window, cylinders, **changes):
    config = BundleAdjustmentConfig(threads=1, **changes)
    return optimise_jointly(window, cylinders.decoder, config)


@pytest.mark.parametrize("use_plane", [True, False])
def test_a_disturbed_window_is_corrected(cylinders, window, truth, use_plane):
    result = optimised(window, cylinders, max_iterations=8, use_plane=use_plane)
    assert result.cost_after < 0.5 * result.cost_before and 0 < result.iterations <= 8
    fixed = window.keyframes[0].T_world_camera
    np.testing.assert_array_equal(result.keyframes[0].T_world_camera, fixed)
    for key, before, T in list(zip(result.keyframes, window.keyframes, truth))[1:]:
        error = np.linalg.norm(key.T_world_camera[:3, 3] - T[:3, 3])
        assert error < 0.004 and error < np.linalg.norm(before.T_world_camera[:3, 3] - T[:3, 3])
    for id, landmark in result.landmarks.items():
        x, y, radius = cylinders.places[id]
        assert np.hypot(*(landmark.state.pose.translation[:2] - (x, y))) < 0.003
        assert landmark.state.pose.scale[:2] == pytest.approx(np.full(2, radius / 0.55), rel=0.05)
        assert landmark.n_updates == 2


def test_the_plane_constrains_the_height_of_the_cameras(cylinders, window):
    """Plane points raised by 3 mm in the second camera lower that camera; without the plane they do not."""
    T = window.keyframes[1].T_world_camera
    raised = [window.plane_points[0], window.plane_points[1] + 0.003 * T[:3, :3].T[:, 2]]
    raised = replace(window, plane_points=[*raised, window.plane_points[2]])

    def height(window, use_plane):
        result = optimised(window, cylinders, max_iterations=4, use_plane=use_plane)
        return result.keyframes[1].T_world_camera[2, 3]

    assert height(raised, True) < height(window, True) - 3e-4
    assert height(raised, False) == height(window, False)


def test_steps_are_limited(cylinders, window):
    limits = StepLimits(translation=1e-4)
    result = optimised(window, cylinders, max_iterations=1, step_limits=limits)
    steps = [x.state.step_from(window.landmarks[id].state) for id, x in result.landmarks.items()]
    assert np.abs(steps)[:, POSITION].max() == pytest.approx(1e-4, rel=1e-6)


def test_landmarks_that_are_not_observed_or_not_in_the_map_take_no_part(cylinders, window):
    fewer = {id: landmark for id, landmark in window.landmarks.items() if id != 1}
    unobserved = replace(cylinders.landmark(0), id=9)
    result = optimised(replace(window, landmarks={**fewer, 9: unobserved}), cylinders, max_iterations=1)
    assert set(result.landmarks) == {0, 2, 3, 4}


def displacement(result, window, id):
    return np.linalg.norm(result.landmarks[id].state.step_from(window.landmarks[id].state))


def test_a_strong_marginal_prior_holds_its_landmark(cylinders, window):
    free = optimised(window, cylinders, max_iterations=4)
    priors = {0: MarginalPrior(1e9 * np.eye(25), np.zeros(25)), 99: MarginalPrior(np.eye(25), np.zeros(25))}
    held = optimised(replace(window, priors=priors), cylinders, max_iterations=4)
    assert displacement(held, window, 0) < 0.01 * displacement(free, window, 0)
    assert displacement(held, window, 1) > 0.5 * displacement(free, window, 1)


def test_a_marginal_prior_pulls_its_landmark_to_where_it_was_observed(cylinders, window):
    start = window.landmarks[0].state
    observed = start.moved(np.concatenate([np.zeros(19), (0.01, 0.0, 0.0), np.zeros(3)]))
    prior = MarginalPrior.of([ViewInformation(observed, 1e9 * np.eye(25))], start, 4.0)
    result = optimised(replace(window, priors={0: prior}), cylinders, max_iterations=8)
    assert np.linalg.norm(result.landmarks[0].state.step_from(observed)[POSITION]) < 1e-3


def test_cameras_move_within_their_covariance(cylinders, window):
    def moves(sigma):
        keyframes = [replace(key, covariance=sigma**2 * np.eye(6)) for key in window.keyframes]
        moved = optimised(replace(window, keyframes=keyframes), cylinders, max_iterations=4).keyframes
        pairs = zip(moved[1:], keyframes[1:])
        return [np.linalg.norm((a.T_world_camera - b.T_world_camera)[:3, 3]) for a, b in pairs]

    assert max(moves(1e-6)) < 1e-5
    assert min(moves(0.1)) > 0.003  # the disturbance is about 1 cm


def test_priors_enter_the_normal_equations_with_their_gradient(cylinders, window):
    """Priors that outweigh the pixels: of the second and third camera, and of landmark 0."""
    covariance, information = 1e-14 * np.eye(6), 1e14 * np.eye(25)
    keyframes = [replace(key, covariance=covariance) for key in window.keyframes]
    priors = {0: MarginalPrior(information, np.zeros(25))}
    camera_step, object_steps = np.full(12, 1e-3), np.zeros((5, 25))
    object_steps[0, POSITION] = 1e-3
    config = BundleAdjustmentConfig(threads=1)
    with ThreadPoolExecutor(1) as pool:
        strong = replace(window, keyframes=keyframes, priors=priors)
        optimiser = _Optimiser(strong, cylinders.decoder, config, pool)
        optimiser.state = optimiser._moved(camera_step, object_steps)
        equations = optimiser._normal_equations(optimiser._evaluate(optimiser.state))
    weight = config.camera_prior_weight * 1e14
    np.testing.assert_allclose(equations.gradient_cameras, weight * camera_step, rtol=1e-3)
    np.testing.assert_allclose(np.diag(equations.cameras), np.full(12, weight), rtol=1e-3)
    np.testing.assert_allclose(equations.gradient_objects[0][POSITION], np.full(3, 1e11), rtol=1e-3)
    np.testing.assert_allclose(np.diag(equations.objects[0]), np.full(25, 1e14), rtol=1e-3)
    cost = weight * 12e-6 + 1e14 * 3e-6
    assert optimiser._prior_cost(optimiser.state) == pytest.approx(cost, rel=1e-6)


def test_each_view_contributes_positive_information(cylinders, window):
    result = optimised(window, cylinders, max_iterations=2)
    exact = optimised(window, cylinders, max_iterations=2, camera_sigma=np.full(6, 1e-6))
    assert set(result.information) == {
        (key.number, id) for key in window.keyframes for id in key.landmark_ids
    }
    for at, view in result.information.items():
        spectrum = np.linalg.eigvalsh(view.information)
        assert spectrum[0] > -1e-6 * spectrum[-1] and spectrum[-1] > 0
        less, more = (np.trace(x.information[POSITION, POSITION]) for x in (view, exact.information[at]))
        assert less < more
        assert view.state is result.landmarks[at[1]].state


def test_views_of_a_well_known_camera_contribute_more(cylinders, window):
    first = replace(window.keyframes[0], covariance=1e-8 * np.eye(6))
    window = replace(window, keyframes=[first, *window.keyframes[1:]])
    result = optimised(window, cylinders, max_iterations=1).information
    exact = optimised(window, cylinders, max_iterations=1, camera_sigma=np.full(6, 1e-6)).information

    def ratio(number, id):
        a, b = (np.trace(x[number, id].information[POSITION, POSITION]) for x in (result, exact))
        return a / b

    for id in first.landmark_ids:
        assert 0.9 < ratio(0, id) <= 1 + 1e-6 and ratio(1, id) < 0.7
