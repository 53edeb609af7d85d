"""Status of a tracked pose by its plausibility and certainty."""

import numpy as np

from perception.slam.motion import CameraMotion, CameraMotionConfig
from perception.slam.pose_check import PoseCheckConfig, check_pose
from perception.slam.tracking import TrackedPose


def checked(step=(0, 0, 0), turn=0.0, ratios=(0.9,), std=0.001):
    """Check a tracked pose with the given position deviation against a vague prediction at the identity."""
    motion = CameraMotion.with_unknown_velocity(0.0, np.eye(4), CameraMotionConfig(), np.eye(6))
    T = np.eye(4)
    T[:3, 3] = step
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    used = frozenset(range(len(ratios)))
    return check_pose(TrackedPose(T, dict(enumerate(ratios)), used, np.eye(6) / std**2), motion)


def check(**changes):
    return checked(**changes)[0]


def test_status_follows_the_thresholds_of_the_pose_check():
    assert check() == "tracked"
    assert check(std=0.0099) == "tracked" and check(std=0.0101) == "weak"
    assert check(std=0.0199) == "weak" and check(std=0.0201) == "lost"
    assert check(step=(0.099, 0, 0)) == "tracked" and check(step=(0.101, 0, 0)) == "lost"
    assert check(turn=np.radians(11.9)) == "tracked" and check(turn=np.radians(12.1)) == "lost"
    assert check(ratios=(0.51, 0.51)) == "tracked" and check(ratios=(0.49, 0.49)) == "lost"
    assert check(step=(np.nan, 0, 0)) == "lost"


def test_motion_is_updated_unless_the_pose_is_implausible():
    accepted, uncertain = checked(step=(0.05, 0, 0))[1], checked(step=(0.05, 0, 0), std=0.03)[1]
    for motion in (accepted, uncertain):
        np.testing.assert_allclose(motion.T_world_camera[:3, 3], (0.05, 0, 0), atol=1e-3)
    assert checked(step=(0.2, 0, 0))[1] is None


def test_a_pose_that_one_frame_does_not_determine_is_lost_however_often_it_is_seen():
    """Thirty frames of 3 cm average to 0.5 cm, if only their errors were independent."""
    motion = CameraMotion.with_unknown_velocity(0.0, np.eye(4), CameraMotionConfig(), 1e-8 * np.eye(6))
    vague = TrackedPose(np.eye(4), {0: 0.9}, frozenset({0}), np.eye(6) / 0.03**2)
    states = []
    for k in range(30):
        status, motion = check_pose(vague, motion.predict(k / 30, CameraMotionConfig()))
        assert motion is not None
        states.append(status)
    assert states[0] == "tracked" and states[-1] == "lost"
    assert motion.position_std < PoseCheckConfig().lost_position_std < motion.correlated_position_std
