"""Paths of a point in the plane around walls: it is free where no sample of a move is in one."""

from itertools import pairwise

import numpy as np
import pytest

from manipulation.path_search import SearchConfig, search_path

LIMITS = (np.array([-2.0, -2.0]), np.array([2.0, 2.0]))
START, GOAL = np.array([-1.0, 0.0]), np.array([1.0, 0.0])


def walls(*boxes):
    """Whether a straight move is outside all boxes (low x, low y, high x, high y)."""

    def is_free(a, b):
        points = a + np.linspace(0, 1, 50)[:, None] * (b - a)
        return not any(((points > box[:2]) & (points < box[2:])).all(axis=1).any() for box in np.array(boxes))

    return is_free


def moves_are_free(path, is_free):
    return all(is_free(a, b) for a, b in pairwise(path))


@pytest.mark.parametrize("gap", [0.8, 1.6])
def test_a_path_leads_around_a_wall(gap):
    is_free = walls((-0.1, -2.1, 0.1, 2.0 - gap))
    path = search_path(START, GOAL, is_free, LIMITS)
    np.testing.assert_array_equal([path[0], path[-1]], [START, GOAL])
    assert moves_are_free(path, is_free)
    assert all((LIMITS[0] <= q).all() and (q <= LIMITS[1]).all() for q in path)


def test_superfluous_waypoints_are_left_out():
    free = walls()
    assert len(search_path(START, GOAL, free, LIMITS)) == 2
    is_free = walls((-0.1, -2.1, 0.1, 0.4))
    direct = search_path(START, GOAL, is_free, LIMITS, SearchConfig(shortcuts=200))
    winding = search_path(START, GOAL, is_free, LIMITS, SearchConfig(shortcuts=0))
    assert len(direct) < len(winding) and moves_are_free(direct, is_free)


def test_branches_are_short():
    longest = []

    def is_free(a, b):
        longest.append(np.abs(b - a).max())
        return walls((-0.1, -2.1, 0.1, 0.4))(a, b)

    assert search_path(START, GOAL, is_free, LIMITS, SearchConfig(step=0.2, shortcuts=0))
    assert max(longest) <= 0.2 + 1e-12


def test_an_enclosed_goal_has_no_path():
    ring = [(0.7, -0.3, 0.8, 0.3), (1.2, -0.3, 1.3, 0.3), (0.7, -0.4, 1.3, -0.2), (0.7, 0.2, 1.3, 0.4)]
    assert search_path(START, GOAL, walls(*ring), LIMITS, SearchConfig(max_samples=200)) is None


def test_the_same_question_has_the_same_answer():
    is_free = walls((-0.1, -2.1, 0.1, 0.4))
    first, second = (search_path(START, GOAL, is_free, LIMITS) for _ in range(2))
    np.testing.assert_array_equal(first, second)
