"""Home postures: reached, pointing down, free; none for an arm that cannot."""

from dataclasses import replace

import numpy as np
import pytest

from app.robots.home import _score, arm_length, find_home
from manipulation.collision import CollisionWorld
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE
from sim_assets.robots import load_robot


@pytest.fixture(scope="module")
def arm():
    return load_robot("sixaxis").description


def test_arm_length_is_that_of_the_stretched_arm(arm):
    """Upper arm 425 mm, forearm 392 mm, wrist 100 mm and hand 200 mm, sideways offset 133 mm."""
    assert 0.9 < arm_length(Kinematics(arm)) < np.hypot(0.425 + 0.392 + 0.1 + 0.25, 0.133)


@pytest.mark.slow
def test_home_points_down_and_is_free(arm):
    kinematics = Kinematics(replace(arm, q_home=np.zeros(6)))
    q = find_home(arm, kinematics)
    T = kinematics.forward(q)
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=2e-3)
    assert T[0, 3] > 0.2 and T[2, 3] > 0.15 and kinematics.limit_distance(q) > 0.2
    assert CollisionWorld(arm, [], (TABLE,)).contact(q, arm.max_width) is None


def test_an_elbow_above_the_wrist_is_better_than_one_below(arm):
    """Both postures hold the hand at one place, far from the joints' limits."""
    kinematics = Kinematics(arm)
    T = kinematics.forward(arm.q_home)
    T[2, 3] -= 0.2
    starts = np.random.default_rng(0).uniform(-np.pi, np.pi, (40, 6))
    found = [kinematics.inverse(T, [start], name="a posture") for start in starts]
    postures = [result.q for result in found if result.converged]
    elbow, wrist = (np.array([kinematics.anchors(q)[i, 2] for q in postures]) for i in (2, -1))
    scores = np.array([_score(kinematics, q) for q in postures])
    assert (elbow > wrist).any() and (elbow < wrist - 0.1).any()
    assert scores[elbow > wrist].max() > scores[elbow < wrist - 0.1].max() + 0.2


def test_an_arm_that_cannot_point_down_has_none(arm, monkeypatch):
    monkeypatch.setattr("app.robots.home.SHARES", (3.0,))
    monkeypatch.setattr("app.robots.home.HEIGHTS", (3.0,))
    monkeypatch.setattr("app.robots.home._SEEDS", 1)
    assert find_home(arm, Kinematics(arm)) is None
