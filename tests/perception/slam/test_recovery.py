"""When a lost camera counts as found."""

import numpy as np
import pytest

from perception.slam.config import SlamConfig
from perception.slam.motion import CameraMotion
from perception.slam.recovery import is_certain, relocalised_motion, searched_motion
from perception.slam.tracking import TrackedPose

CONFIG = SlamConfig()
LIMIT = CONFIG.pose_check.recovered_position_std
AGREES = CONFIG.lifecycle.support_inlier_ratio + 0.01


def tracked(std=0.001, ratios=(AGREES, AGREES), step=0.0):
    T = np.eye(4)
    T[0, 3] = step
    used = frozenset(range(len(ratios)))
    return TrackedPose(T, dict(enumerate(ratios)), used, np.eye(6) / std**2)


@pytest.fixture
def guess():
    """A vague prediction at the identity."""
    return CameraMotion.with_unknown_velocity(1.0, np.eye(4), CONFIG.motion, np.eye(6), period=0.1)


@pytest.mark.parametrize(
    ("found", "changes"),
    [
        (True, {}),
        (True, {"std": 0.99 * LIMIT}),
        (False, {"std": 1.01 * LIMIT}),
        (False, {"ratios": (AGREES,)}),
        (False, {"ratios": (AGREES, AGREES - 0.02)}),
    ],
)
def test_a_search_needs_certainty_and_two_agreeing_landmarks(guess, found, changes):
    motion, is_found = searched_motion(tracked(**changes), guess, CONFIG)
    assert is_found == found and motion is not guess


def test_an_implausible_search_leaves_the_prediction(guess):
    assert searched_motion(tracked(step=1.0), guess, CONFIG) == (guess, False)


def test_a_relocalised_camera_has_unknown_velocity():
    motion = relocalised_motion(tracked(std=0.002, step=3.0), 5.0, 0.1, CONFIG)
    assert (motion.time, motion.period) == (5.0, 0.1) and not motion.velocity.any()
    assert motion.T_world_camera[0, 3] == 3.0
    assert motion.position_std == pytest.approx(0.002, rel=1e-6)
    assert is_certain(motion, CONFIG)


def test_a_relocalised_pose_without_information_is_uncertain():
    nothing = TrackedPose(np.eye(4), {}, frozenset(), np.zeros((6, 6)))
    motion = relocalised_motion(nothing, 5.0, 0.1, CONFIG)
    assert np.isfinite(motion.position_std) and not is_certain(motion, CONFIG)
