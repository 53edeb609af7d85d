"""Outcomes of the objects of a task, and second chances."""

import numpy as np
import pytest

from manipulation.task_progress import TaskProgress
from manipulation.types import ObjectOutcome, Placement
from perception.geometry import pose_from_yaw

HEIGHT = 0.004


def goal(name, stack=()):
    return Placement(name, (0.4, 0.2, 0.01), (0.0,), tuple(stack), release_height=0.02)


@pytest.fixture
def progress():
    goals = [goal("a"), goal("b", ["a"]), goal("c", ["there_before", "a", "b"])]
    return TaskProgress({"a": 0, "b": 1, "c": 2}, goals, HEIGHT)


def placed(name):
    return ObjectOutcome(0, name, True, 1, "", np.eye(4))


def failed(name, attempts=2):
    return ObjectOutcome(0, name, False, attempts, "slipped")


def test_an_object_gets_one_more_chance(progress):
    assert not progress.gets_another_chance(placed("a")) and progress.before("a") is None
    first = failed("a")
    assert progress.gets_another_chance(first) and progress.before("a") is first
    assert not progress.gets_another_chance(failed("a"))
    assert progress.gets_another_chance(failed("b"))


def test_attempts_of_both_chances_count(progress):
    assert progress.failed_attempt("b", 1, "why") == ObjectOutcome(1, "b", False, 1, "why")
    progress.gets_another_chance(failed("b", attempts=3))
    assert progress.failed_attempt("b", 1, "why").attempts == 4


def test_a_bowl_waits_for_those_below_it_that_have_a_goal(progress):
    b, c = progress.goals["b"], progress.goals["c"]
    assert progress.waits_for_stack(b) and not progress.waits_for_stack(b, besides="a")
    assert not progress.waits_for_stack(progress.goals["a"])
    progress.record(failed("a"))
    assert not progress.waits_for_stack(b) and progress.waits_for_stack(c)


def test_a_bowl_goes_into_the_bowls_that_are_there(progress):
    poses = {
        name: pose_from_yaw(0.0, np.array([k, 2.0 * k, 0.5]))
        for k, name in enumerate(["there_before", "a", "b"])
    }
    c = progress.goals["c"]
    only = progress.with_placed_stack(c, poses)
    assert only.stack == ("there_before",) and only.position == (0.0, 0.0, 0.01)
    progress.record(placed("a"))
    progress.record(failed("b"))
    two = progress.with_placed_stack(c, poses)
    assert two.stack == ("there_before", "a") and two.position == (1.0, 2.0, 0.01)
    assert progress.with_placed_stack(c, poses, besides="b").stack == c.stack
    assert two.release_height == c.release_height


def test_a_bowl_without_any_below_it_is_released_as_on_the_floor(progress):
    alone = progress.with_placed_stack(progress.goals["b"], {})
    assert alone.stack == () and alone.release_height == HEIGHT
    assert alone.position == progress.goals["b"].position
    assert progress.with_placed_stack(progress.goals["a"], {}) is progress.goals["a"]


def test_what_is_placed_and_what_is_below_it(progress):
    progress.record(placed("a"))
    progress.record(placed("b"))
    progress.record(failed("c"))
    assert progress.placed() == {"a", "b"}
    assert progress.is_placed("a") and not progress.is_placed("c") and not progress.is_placed("d")
    assert progress.below_others() == {"there_before", "a", "b"}
    assert progress.reopen("b") and not progress.reopen("b")
    assert progress.placed() == {"a"}


def test_objects_that_a_stopped_robot_leaves(progress):
    progress.gets_another_chance(failed("c", attempts=2))
    outcomes = progress.give_up(["b", "c"], "stopped by hand")
    assert [(o.name, o.attempts, o.reason) for o in outcomes] == [
        ("b", 1, "stopped by hand"),
        ("c", 2, "stopped by hand"),
    ]
    T = pose_from_yaw(0.3, np.zeros(3))
    results = {o.name: o for o in progress.results({"b": T})}
    assert results["b"].T_world_left is T and results["c"].T_world_left is None


def test_results_have_the_latest_places_and_the_directions_of_the_goals(progress):
    """The bowl below is pushed aside by another one; a mug that was turned is not as it should be."""
    released, pushed = pose_from_yaw(0.0, np.zeros(3)), pose_from_yaw(0.5, np.array([0.0, 0.03, 0.0]))
    for name in ("a", "b"):
        progress.record(ObjectOutcome(1, name, True, 1, "", released))
    results = {o.name: o for o in progress.results({"a": pushed})}
    np.testing.assert_array_equal(results["a"].T_world_stand, pose_from_yaw(0.0, np.array([0.0, 0.03, 0.0])))
    assert results["b"].T_world_stand is released, "nothing newer is known of it"
