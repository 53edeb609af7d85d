import numpy as np
import pytest

from manipulation.observation import (
    LEVER,
    MOVED,
    TIPPED,
    TURNED,
    Finding,
    NoObserver,
    classify_grip,
    is_displaced,
    is_turned,
)
from manipulation.types import Grasp
from perception.geometry import pose_from_yaw

HELD = Grasp("top", np.eye(4), np.array([0.0, 0.0, 1.0]), 0.06, 0.04, (0.02, 0.05), 0.05, 0.02, 0.0, 1.0)


@pytest.mark.parametrize(
    "width, grip",
    [(0.0, "empty"), (0.0199, "empty"), (0.02, "held"), (0.05, "held"), (0.0501, "wide"), (0.08, "wide")],
)
def test_finger_width(width, grip):
    assert classify_grip(width, HELD) == grip


def tilted(T, angle):
    turned = T.copy()
    c, s = np.cos(angle), np.sin(angle)
    turned[:3, :3] = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ T[:3, :3]
    return turned


def test_shift_and_tilt_decide_but_not_yaw_and_height():
    T = pose_from_yaw(0.3, np.array([0.5, -0.2, 0.0]))
    shifted, raised = T.copy(), T.copy()
    shifted[:2, 3] += np.array([0.6, 0.8]) * (MOVED + 1e-4)
    raised[2, 3] += 0.05
    assert is_displaced(T, shifted)
    assert not is_displaced(T, raised) and not is_displaced(T, pose_from_yaw(2.0, T[:3, 3]))
    assert is_displaced(T, tilted(T, TIPPED + 0.01)) and not is_displaced(T, tilted(T, TIPPED - 0.01))
    assert is_displaced(T, tilted(T, 0.11), tipped=0.1) and not is_displaced(T, tilted(T, 0.09), tipped=0.1)


@pytest.mark.parametrize("moved", [MOVED, 0.1])
def test_an_object_on_its_side_may_turn_by_what_its_ends_may_shift(moved):
    """About the vertical; one on its head as one that stands."""
    T, limit = tilted(np.eye(4), np.pi / 2), min(TIPPED, moved / LEVER)
    for by in (limit + 0.01, limit - 0.01):
        assert is_displaced(T, pose_from_yaw(by, np.zeros(3)) @ T, moved) == (by > limit)
    on_head = tilted(np.eye(4), np.pi)
    assert not is_displaced(on_head, tilted(on_head, TIPPED - 0.01), moved)


@pytest.mark.parametrize("yaw", [0.3, 3.1, -3.1])
def test_the_shorter_way_around_decides_about_a_turn(yaw):
    T = pose_from_yaw(yaw, np.zeros(3))
    for by, turned in ((TURNED + 0.01, True), (-TURNED - 0.01, True), (TURNED - 0.01, False)):
        assert is_turned(T, pose_from_yaw(yaw + by, np.array([0.1, 0.0, 0.0]))) == turned


def test_noise_of_a_fit_is_no_motion_and_5_cm_always_are():
    """With 3 mm of noise in x and y, a limit of 12 mm is exceeded once in exp(-8) = 1/3000 looks."""
    rng = np.random.default_rng(0)
    T = np.eye(4)
    decisions = []
    for moved in (0.0, 0.05):
        for _ in range(500):
            seen = T.copy()
            seen[:2, 3] = rng.normal(0, 0.003, 2) + np.array([moved, 0.0])
            decisions.append(is_displaced(T, seen))
    assert sum(decisions[:500]) <= 2 and all(decisions[500:])


def test_without_an_observer_nothing_is_known():
    nobody = NoObserver()
    assert nobody.glance({}, ("can_1",)) == {} and nobody.find("can_1", {}) == Finding("unseen")
