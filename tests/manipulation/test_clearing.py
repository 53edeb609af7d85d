"""How often objects are set aside and pushed, and when they are searched for; plans and motions are given."""

import numpy as np
import pytest

from manipulation.clearing import MAX_PUSHES, Clearing
from manipulation.errors import GraspFailedError, RobotError, RobotStoppedError, SceneChangedError
from manipulation.object_planning import ObjectPlanning
from manipulation.plan_execution import PlanExecution
from manipulation.pushing import Push
from manipulation.scene_following import SceneFollowing, Searched
from manipulation.types import PickPlacePlan


def made(cls, **values):
    """Return an instance that has the given attributes alone."""
    instance = object.__new__(cls)
    vars(instance).update(values)
    return instance


def plan_of(name):
    return made(PickPlacePlan, name=name, grasp=None)


class Planning(ObjectPlanning):
    def __init__(self):
        pass

    def plans_aside(self, names, movable, q):
        return iter([plan_of(name) for name in names if name in movable])

    def push(self, name, q):
        return made(Push, name=name)


class Motion(PlanExecution):
    """Fails with ``error``, if there is one."""

    def __init__(self, calls):
        self.calls, self.error = calls, None
        self.recovery = self

    def run(self, plan, looks_first=True):
        self.push(plan)

    def push(self, push):
        self.calls.append(("moved", push.name))
        if self.error is not None:
            raise self.error

    def back_off(self, grasp=None):
        self.calls.append(("back off",))


class Scene(SceneFollowing):
    def __init__(self, calls):
        self.calls = calls

    def search(self, name):
        self.calls.append(("search", name))
        return Searched()


class Cell:
    """A robot at rest, with all that is done in ``calls``."""

    def __init__(self, arm):
        self.arm = arm
        self.calls = []
        self.motion = Motion(self.calls)

    def joint_positions(self):
        return np.array(self.arm.q_home)

    state = stop = gripper_width = follow = move_gripper = capture = joint_positions  # not called


@pytest.fixture
def cell(arm):
    return Cell(arm)


@pytest.fixture
def clearing(cell):
    return Clearing(cell, Planning(), cell.motion, Scene(cell.calls))


def test_each_object_is_set_aside_once_in_the_order_given(cell, clearing):
    for name in ("b", "a"):
        plan = clearing.plan_aside(["c", "b", "a"], {"a", "b"})
        assert plan is not None and plan.name == name
        clearing.set_aside(plan)
    assert clearing.plan_aside(["c", "b", "a"], {"a", "b"}) is None
    assert cell.calls == [("moved", "b"), ("moved", "a")]


@pytest.mark.parametrize(
    ("error", "backs_off"),
    [(SceneChangedError("gone"), False), (GraspFailedError("empty"), True), (RobotError("blocked"), True)],
)
def test_what_was_not_set_aside_is_searched_for(cell, clearing, error, backs_off):
    cell.motion.error = error
    clearing.set_aside(plan_of("a"))
    assert cell.calls == [("moved", "a"), *([("back off",)] if backs_off else []), ("search", "a")]
    assert clearing.plan_aside(["a"], {"a"}) is None


@pytest.mark.parametrize("error", [None, RobotError("blocked")])
def test_what_was_pushed_is_searched_for_and_pushed_no_more_than_allowed(cell, clearing, error):
    cell.motion.error = error
    for _ in range(MAX_PUSHES):
        push = clearing.plan_push("a")
        assert push is not None
        clearing.push(push)
    assert clearing.plan_push("a") is None and clearing.plan_push("b") is not None
    once = [("moved", "a"), *([("back off",)] if error else []), ("search", "a")]
    assert cell.calls == MAX_PUSHES * once


def test_a_stop_ends_the_task(cell, clearing):
    cell.motion.error = RobotStoppedError("by the person")
    with pytest.raises(RobotStoppedError):
        clearing.set_aside(plan_of("a"))
