"""Objects in the box that get another class: their names, where they are, and where they were."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from app.task import nests
from app.task.nests import as_seen_now, with_bowls_named
from app.task.rounds import placed_estimates, placed_items
from app.task.task_types import TaskResult
from manipulation.types import Box, GraspSet, ObjectOutcome, Placement
from perception.geometry import pose_from_yaw
from perception.inference.refit import PoseCheck
from perception.pipeline import Perception
from perception.types import SupportPlane

BOX = Box()
FLOOR = SupportPlane(offset=BOX.floor)
REST = pose_from_yaw(np.pi / 2, np.array([0.5, 0.27, BOX.floor]))
NONE = GraspSet((), Counter())
CHECK = PoseCheck(np.eye(4), "seen", 0.9, 5000, 0.0, 0.0)


@pytest.fixture
def result(can_at, pack_plan):
    """Two cans in the box; something of the second is to go into the first."""
    goals = (*pack_plan.placements, Placement("can_1", (0.5, 0.27, 0.05), (0.0,), ("can_0",)))
    outcomes = [
        ObjectOutcome(0, "can_0", True, 1, "", REST),
        ObjectOutcome(1, "can_1", True, 2, "", pose_from_yaw(0.0, np.array([0.4, 0.3, BOX.floor]))),
    ]
    plan = replace(pack_plan, placements=goals, left_out={}, grasps={"can_0": NONE, "can_1": NONE})
    return TaskResult(objects=[can_at(0), can_at(1, 0.5)], plan=plan, outcomes=outcomes)


@pytest.fixture
def bowl(result):
    """What was taken for the first can, seen 6 mm beside its place."""
    seen = replace(placed_estimates(result)[0], category="bowl")
    T = seen.T_world_object.copy()
    T[0, 3] += 0.006
    return replace(seen, T_world_object=T)


def test_a_renamed_object_is_in_the_box_where_it_was_seen(result, bowl):
    named = as_seen_now(result, {0: bowl}, FLOOR)
    np.testing.assert_allclose(placed_estimates(named)[0].T_world_object, bowl.T_world_object, atol=1e-9)
    np.testing.assert_allclose(
        placed_items(named)["bowl_0"].T_world_stand[:3, 3], (0.506, 0.27, BOX.floor), atol=1e-9
    )
    assert set(placed_items(named)) == {"bowl_0", "can_1"}
    np.testing.assert_array_equal(
        placed_estimates(named)[1].T_world_object, placed_estimates(result)[1].T_world_object
    )


def test_a_renamed_object_was_on_the_table_where_it_was_found(result, bowl, can_at):
    first, other = as_seen_now(result, {0: bowl}, FLOOR).objects
    assert first.name == "bowl_0" and other is result.objects[1]
    # The difference to the place that was expected is kept, in the frame of the object.
    moved = first.T_world_object - can_at(0).T_world_object
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(0.006)


def test_the_plan_and_the_outcomes_have_the_new_name(result, bowl):
    named = as_seen_now(result, {0: bowl}, FLOOR)
    assert [p.name for p in named.plan.placements] == ["bowl_0", "can_1"]
    assert [p.stack for p in named.plan.placements] == [(), ("bowl_0",)]
    assert set(named.plan.objects) == {"bowl_0", "can_1"} and set(named.plan.grasps) == {"can_1"}
    assert [(o.name, o.attempts) for o in named.outcomes] == [("bowl_0", 1), ("can_1", 2)]


def test_only_what_is_seen_on_the_floor_of_the_box_is_named(result, bowl, monkeypatch):
    asked = []
    monkeypatch.setattr(nests, "mistaken_bowls", lambda standing, *_: asked.append(set(standing)) or {})
    networks = object.__new__(Perception)
    object.__setattr__(networks, "detector", None)
    object.__setattr__(networks, "decoder", None)
    hidden = replace(CHECK, status="hidden")
    result = replace(result, checks={0: CHECK, 1: hidden})
    assert with_bowls_named(result, BOX, networks) is result
    raised = REST.copy()
    raised[2, 3] += 0.03  # in another bowl
    inside = replace(result.outcomes[0], T_world_stand=raised)
    with_bowls_named(replace(result, outcomes=[inside], checks={0: CHECK}), BOX, networks)
    assert asked == [{0}, set()]
    monkeypatch.setattr(nests, "mistaken_bowls", lambda *_: {0: bowl})
    assert with_bowls_named(result, BOX, networks).objects[0].name == "bowl_0"
