"""A frame of cylinders, tracked against the true map from a displaced prediction."""

from dataclasses import replace

import numpy as np

from perception.geometry import se3_exp
from perception.slam.config import SlamConfig
from perception.slam.frame_tracking import track_view
from perception.slam.mapping import Mapper
from perception.slam.motion import CameraMotion

STEP = np.array([0.003, -0.004, 0.002, 0.004, -0.003, 0.003])


def tracked(cylinders, observe, T_view, **changes):
    config = SlamConfig()
    mapper = Mapper(cylinders.plane, cylinders.decoder, config)
    mapper.world = cylinders.map()
    mapper.world = mapper.world.with_landmarks(replace(mapper.world.landmarks[0], **changes))
    T_predicted = T_view @ se3_exp(STEP)
    predicted = CameraMotion.with_unknown_velocity(0.0, T_predicted, config.motion, 1e-4 * np.eye(6))
    view = observe(T_view).with_pose(T_predicted)
    return track_view(mapper, view, predicted, lambda: None, config)


def test_the_true_pose_is_found(cylinders, observe, T_view):
    result = tracked(cylinders, observe, T_view)
    assert np.linalg.norm(result.tracked.T_world_camera[:3, 3] - T_view[:3, 3]) < 0.002
    assert result.tracked.used == {0, 1, 2, 3, 4} and len(result.plane_points) > 100
    assert result.unseen_ratios == dict.fromkeys(range(5), 0.0)


def test_landmarks_that_disagreed_repeatedly_are_judged_but_not_used(cylinders, observe, T_view):
    result = tracked(cylinders, observe, T_view, n_outlier_frames=2)
    assert result.tracked.used == {1, 2, 3, 4} and 0 in result.tracked.inlier_ratios
