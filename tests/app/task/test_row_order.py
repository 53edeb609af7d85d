"""Which objects on the rows are measured again, and what becomes of their sizes."""

from dataclasses import replace

import numpy as np
import pytest

from app.task import row_order
from app.task.rounds import placed_estimates, placed_items
from app.task.row_order import CHANGED, partly_hidden, with_sizes_measured
from app.task.task_types import TaskResult
from manipulation.types import ObjectOutcome
from perception.geometry import pose_from_yaw
from perception.inference.refit import PoseCheck
from perception.pipeline import Perception
from perception.types import TriangleMesh

AT = pose_from_yaw(0.4, np.array([0.5, 0.25, 0.0]))
CHECK = PoseCheck(np.eye(4), "seen", 0.9, 5000, 0.0, 0.0)


@pytest.fixture
def networks():
    networks = object.__new__(Perception)
    object.__setattr__(networks, "detector", "detector")
    object.__setattr__(networks, "decoder", "decoder")
    return networks


@pytest.fixture
def result(can_at, pack_plan):
    """Two cans on the rows, of which the first one lay on the table."""
    outcomes = [
        ObjectOutcome(0, "can_0", True, 1, "", AT),
        ObjectOutcome(1, "can_1", True, 1, "", pose_from_yaw(0.0, np.array([0.4, 0.3, 0.0]))),
    ]
    objects = [replace(can_at(0), resting="lying"), can_at(1, 0.5)]
    plan = replace(pack_plan, task="sort", box=None)
    return TaskResult(objects=objects, plan=plan, outcomes=outcomes, checks={0: CHECK, 1: CHECK})


def test_what_lay_stood_on_something_or_carried_something_was_partly_hidden(result, can_at):
    assert partly_hidden(result) == {0}
    upper = replace(can_at(2), rests_on=1)
    assert partly_hidden(replace(result, objects=[*result.objects, upper])) == {0, 1}, "it is not placed"
    placed = [*result.outcomes, ObjectOutcome(2, "can_2", True, 1, "", AT)]
    assert partly_hidden(replace(result, objects=[*result.objects, upper], outcomes=placed)) == {0, 1, 2}
    failed = [replace(outcome, placed=False) for outcome in result.outcomes]
    assert partly_hidden(replace(result, outcomes=failed)) == set()


@pytest.mark.parametrize(("change", "is_new"), [(2.0, True), (0.4, False)])
def test_a_size_that_changes_is_that_of_the_object_from_then_on(
    result, networks, monkeypatch, change, is_new
):
    asked = []

    def remeasured(estimates, others, frames, plane, network, decoder):
        asked.append((set(estimates), [e.id for e in others], network, decoder))
        mesh = estimates[0].mesh
        scale = np.array([1.0, 1.0, 1.0 + 2 * change * CHANGED / 0.1])  # half of it above the middle
        taller = TriangleMesh(mesh.vertices * scale, mesh.faces)
        return {0: replace(estimates[0], mesh=taller, resting="upright")}

    monkeypatch.setattr(row_order, "remeasured", remeasured)
    measured = with_sizes_measured(result, {0}, networks)
    assert asked == [({0}, [1], "detector", "decoder")]
    if not is_new:
        assert measured is result
        return
    now = placed_estimates(measured)[0]
    assert now.size > placed_estimates(result)[0].size + CHANGED
    assert placed_items(measured)["can_0"].size == now.size
    assert measured.objects[0].resting == "lying" and measured.objects[1] is result.objects[1]
    np.testing.assert_allclose(
        measured.objects[0].T_world_object, result.objects[0].T_world_object, atol=1e-9
    )


def test_what_is_not_seen_is_not_measured(result, networks, monkeypatch):
    asked = []
    monkeypatch.setattr(row_order, "remeasured", lambda estimates, *_: asked.append(set(estimates)) or {})
    for checks in ({0: replace(CHECK, status="hidden")}, {1: CHECK}):
        assert with_sizes_measured(replace(result, checks=checks), {0}, networks).plan is result.plan
    assert asked == [set(), set()]
