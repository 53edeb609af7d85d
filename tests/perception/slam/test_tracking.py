"""Tracking from disturbed poses, with moved and truncated objects, and the information of a frame."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.inference.problem import FitState
from perception.rendering.pose import ObjectPose, object_by_camera
from perception.slam.landmarks import fit_covariance
from perception.slam.pixels import TrackingPixels, select_pixels
from perception.slam.tracking import TrackedPose, TrackingConfig, _PoseProblem, track

WEAK_PRIOR = TrackingConfig(rotation_sigma=np.radians(4.0), translation_sigma=0.04)


@pytest.fixture
def pixels(cylinders, observe, T_view):
    return select_pixels(observe(T_view), cylinders.plane)


def position_error(found, T):
    return np.linalg.norm(found.T_world_camera[:3, 3] - T[:3, 3])


@pytest.mark.parametrize("seed", range(4))
def test_finds_the_pose_from_a_disturbed_start(cylinders, observe, T_view, seed):
    rng = np.random.default_rng(seed)
    error = np.concatenate([rng.normal(0, np.radians(0.8), 3), rng.normal(0, 0.008, 3)])
    T_start = T_view @ se3_exp(error)
    pixels = select_pixels(observe(T_view).with_pose(T_start), cylinders.plane)
    config = replace(WEAK_PRIOR, iterations=8, use_plane=False)
    found = track(cylinders.map(), pixels, T_start, config)
    assert position_error(found, T_view) < 0.003
    assert found.median_inlier_ratio > 0.9 and len(found.used) == 5
    np.testing.assert_allclose(
        found.T_world_camera[:3, :3] @ found.T_world_camera[:3, :3].T, np.eye(3), atol=1e-12
    )


def test_a_strong_prior_holds_the_predicted_pose(cylinders, T_view, pixels):
    T_start = T_view @ se3_exp(np.array([0, 0, 0, 0.01, 0, 0]))
    held = track(cylinders.map(), pixels, T_start, TrackingConfig(), prior=1e12 * np.eye(6))
    assert position_error(held, T_start) < 1e-5
    config = TrackingConfig(iterations=8)
    by_config, given = (
        track(cylinders.map(), pixels, T_start, config, prior=prior)
        for prior in (None, np.diag(np.repeat([np.radians(0.8) ** -2, 0.008**-2], 3)))
    )
    np.testing.assert_allclose(by_config.T_world_camera, given.T_world_camera)


def test_the_plane_determines_tilt_and_height(cylinders, observe, T_view):
    T_start = T_view @ se3_exp(np.array([0.01, 0.01, 0, 0, 0.005, 0.01]))
    pixels = select_pixels(observe(T_view).with_pose(T_start), cylinders.plane)
    found = track(cylinders.map(), pixels, T_start, replace(WEAK_PRIOR, iterations=6))
    cosine = found.T_world_camera[2, :3] @ T_view[2, :3]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 0.05
    assert abs(found.T_world_camera[2, 3] - T_view[2, 3]) < 5e-4


def test_ring_pixels_are_compared_with_the_escape_depth(cylinders, T_view, pixels):
    """Where their rays miss the object the residual is 0, whatever is measured behind."""
    T_start = T_view @ se3_exp(np.array([0, 0, 0, 0.004, 0, 0]))
    config = TrackingConfig(iterations=4, use_plane=False)
    elsewhere = replace(pixels, depth=np.where(pixels.is_object, pixels.depth, pixels.depth + 1))
    found, same = (track(cylinders.map(), p, T_start, config).T_world_camera for p in (pixels, elsewhere))
    np.testing.assert_array_equal(found, same)
    ring = pixels.subset(~pixels.is_object)
    problem = _PoseProblem(cylinders.map(), ring, T_view, config, None)
    rows = problem.evaluate(T_view, frozenset(range(5)))
    assert np.median(np.abs(rows.residuals[:-6])) < 1e-4


def test_a_moved_object_is_not_used(cylinders, T_view, pixels):
    world = cylinders.map()
    landmark = world.landmarks[0]
    pose = landmark.state.pose
    moved = ObjectPose(pose.rotation, pose.translation + np.array((0.04, 0.02, 0)), pose.scale)
    world = world.with_landmarks(landmark.with_state(FitState(moved, landmark.state.code)))
    found = track(world, pixels, T_view, TrackingConfig(iterations=6))
    assert found.used == {1, 2, 3, 4} and found.inlier_ratios[0] < 0.5
    assert found.median_inlier_ratio_of_used > 0.8
    assert position_error(found, T_view) < 0.003
    tolerant = track(world, pixels, T_view, TrackingConfig(iterations=6, inlier_ratio_min=0.0))
    assert 0 in tolerant.used


def test_excluded_landmarks_are_judged_but_not_used(cylinders, T_view, pixels):
    found = track(cylinders.map(), pixels, T_view, TrackingConfig(), frozenset({1, 2}))
    assert found.used == {0, 3, 4} and set(found.inlier_ratios) == {0, 1, 2, 3, 4}
    everything = frozenset(range(5))
    assert track(cylinders.map(), pixels, T_view, TrackingConfig(), everything).used == everything


def test_without_pixels_the_prediction_remains(cylinders, T_view, pixels):
    empty = TrackingPixels(*(values[:0] for values in vars(pixels).values()))
    found = track(cylinders.map(), empty, T_view, TrackingConfig())
    assert found.median_inlier_ratio == 0 and not found.used and not found.information.any()
    np.testing.assert_allclose(found.T_world_camera, T_view, atol=1e-9)


def test_pixels_of_unknown_landmarks_are_ignored(cylinders, T_view, pixels):
    found = track(cylinders.map().without({3}), pixels, T_view, TrackingConfig())
    assert 3 not in found.used | set(found.inlier_ratios)


def test_median_inlier_ratios():
    ratios = {1: 0.2, 2: 0.9, 3: 0.7}
    found = TrackedPose(np.eye(4), ratios, frozenset({2, 3}), np.eye(6))
    assert found.median_inlier_ratio == 0.7 and found.median_inlier_ratio_of_used == pytest.approx(0.8)
    assert replace(found, used=frozenset()).median_inlier_ratio_of_used == 0


def test_landmarks_with_few_pixels_are_not_judged(cylinders, T_view, pixels):
    n = {id: int((pixels.is_object & (pixels.landmark_ids == id)).sum()) for id in range(5)}
    few = min(n.values())
    assert len(track(cylinders.map(), pixels, T_view, TrackingConfig(min_pixels=few)).inlier_ratios) == 5
    ratios = track(cylinders.map(), pixels, T_view, TrackingConfig(min_pixels=few + 1)).inlier_ratios
    assert set(ratios) == {id for id in n if n[id] > few}


def test_landmarks_that_are_not_judged_stay_in_use(cylinders, T_view, pixels):
    own = pixels.landmark_ids == 2
    few = pixels.subset(~own | (np.cumsum(own) <= TrackingConfig().min_pixels - 1))
    found = track(cylinders.map(), few, T_view, TrackingConfig(iterations=0))
    assert set(found.inlier_ratios) == {0, 1, 3, 4} and found.used == {0, 1, 2, 3, 4}


def test_the_prior_is_a_quadratic_in_the_step_from_the_prediction(cylinders, T_view, pixels):
    rng = np.random.default_rng(0)
    A, xi = rng.normal(size=(6, 6)), 0.01 * rng.normal(size=6)
    information = A @ A.T + np.eye(6)
    problem = _PoseProblem(cylinders.map(), pixels, T_view, TrackingConfig(), information)
    rows = problem._prior_rows(T_view @ se3_exp(xi))
    assert rows.residuals @ rows.residuals == pytest.approx(xi @ information @ xi)
    np.testing.assert_allclose(rows.jacobian.T @ rows.residuals, information @ xi, rtol=1e-9)


def test_the_plane_adds_information(cylinders, T_view, pixels):
    both = track(cylinders.map(), pixels, T_view, TrackingConfig(iterations=0)).information
    config = TrackingConfig(iterations=0, use_plane=False)
    alone = track(cylinders.map(), pixels, T_view, config).information
    assert np.linalg.eigvalsh(both - alone)[0] > -1e-6 * np.trace(both)
    assert np.linalg.eigvalsh(alone)[0] < np.linalg.eigvalsh(both)[0]


def test_information_is_bounded_by_that_on_the_landmarks(cylinders, T_view, pixels):
    config, exact, vague = TrackingConfig(use_plane=False), 1e-9 * np.eye(6), fit_covariance(truncated=True)

    def information(covariance):
        world = cylinders.map()
        world = world.with_landmarks(*(replace(x, covariance=covariance) for x in world.landmarks.values()))
        return track(world, pixels, T_view, config).information

    of_exact, of_vague = information(exact), information(vague)
    assert np.linalg.eigvalsh(of_exact - of_vague)[0] > -1e-6 * np.trace(of_exact)
    bound = np.zeros((6, 6))
    for landmark in cylinders.map().landmarks.values():
        by_camera = object_by_camera(landmark.state.pose, T_view)
        bound += by_camera.T @ np.linalg.inv(vague) @ by_camera
    assert np.linalg.eigvalsh(bound - of_vague)[0] > -1e-6 * np.trace(bound)


def test_weights_scale_the_information(cylinders, T_view, pixels):
    """With exactly known landmarks the information is J^T W J, and W follows the weights of the config."""
    world = cylinders.map()
    exact = (replace(x, covariance=1e-12 * np.eye(6)) for x in world.landmarks.values())
    world = world.with_landmarks(*exact)
    config = TrackingConfig(use_plane=False, use_uncertainty=False, iterations=0, huber=1e6)

    def trace(pixels=pixels, **changes):
        return np.trace(track(world, pixels, T_view, replace(config, **changes)).information)

    reference = trace()
    assert trace(data_weight=0.1) == pytest.approx(2 * reference, rel=1e-3)
    assert trace(depth_sigma=0.006) == pytest.approx(reference / 4, rel=1e-3)
    assert trace(use_uncertainty=True) < 0.9 * reference
    assert trace(huber=0.01) < 0.5 * reference
    ring = trace(pixels.subset(~pixels.is_object), background_weight=1.0)
    own = trace(pixels.subset(pixels.is_object))
    assert reference == pytest.approx(own + 0.2 * ring, rel=1e-3)


def test_truncated_landmarks_weigh_less_while_enough_others_are_used(cylinders, T_view, pixels):
    world = cylinders.map()

    def information(*truncated):
        changed = world.with_landmarks(*(replace(world.landmarks[id], truncated=True) for id in truncated))
        found = track(changed, pixels, T_view, TrackingConfig(use_plane=False))
        assert len(found.used) == 5
        return np.trace(found.information)

    complete = information()
    assert information(0) < 0.95 * complete and information(0, 1) < 0.95 * complete
    assert information(0, 1, 2) == pytest.approx(complete, rel=1e-6)  # only two others
