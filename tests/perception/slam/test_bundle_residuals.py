"""Residuals of one object in a window, and their derivatives with respect to the cameras."""

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.slam.bundle_residuals import ObjectInWindow
from perception.slam.bundle_window import BundleAdjustmentConfig, BundleWindow
from perception.slam.keyframes import Keyframe


@pytest.fixture(scope="module")
def evaluated(cylinders, scenes, observe):
    """Return a function that evaluates a landmark at a displacement of the third camera, and the object."""
    Ts = [scenes.orbit((0, 0.03, 0.03), 0.55, 42, azimuth) for azimuth in (0, 14, 28)]
    keyframes = [Keyframe.of(observe(T, number), np.eye(6)) for number, T in enumerate(Ts)]
    landmark = cylinders.map().landmarks[0]
    window = BundleWindow(keyframes, {0: landmark}, cylinders.plane, [np.zeros((0, 3))] * 3)
    item = ObjectInWindow(landmark, [0, 2], window, BundleAdjustmentConfig())

    def evaluate(xi):
        poses = np.stack([Ts[0], Ts[1], Ts[2] @ se3_exp(xi)])
        return item.evaluate(landmark.state, landmark.shape, poses)

    return evaluate, item


def test_pixels_are_those_of_the_views_that_observe_the_object(evaluated):
    evaluate, item = evaluated
    assert set(item.pixels.rays.view) == {0, 1}
    evaluation = evaluate(np.zeros(6))
    assert evaluation.camera_jacobian.shape == (len(item.pixels.target), 6)
    assert len(evaluation.problem.residuals) > len(item.pixels.target)  # the support camera's as well


@pytest.mark.parametrize("axis", range(6))
def test_camera_jacobian_is_the_derivative_by_the_cameras_pose(evaluated, axis):
    evaluate, item = evaluated
    step = np.zeros(6)
    step[axis] = 1e-3
    n, own = len(item.pixels.target), item.pixels.rays.view == 1
    ahead, behind = (evaluate(sign * step).problem.residuals[:n] for sign in (1, -1))
    difference = (ahead - behind).astype(np.float64) / 2e-3
    np.testing.assert_allclose(difference[~own], 0.0, atol=1e-6)
    derivative = evaluate(np.zeros(6)).camera_jacobian[own, axis]
    typical = np.abs(derivative).max()
    assert typical > 0.05
    assert np.median(np.abs(difference[own] - derivative)) < 0.05 * typical
    assert np.corrcoef(difference[own], derivative)[0, 1] > 0.8  # pixels at the silhouette differ
