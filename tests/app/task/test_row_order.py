"""Which objects on the rows are measured again, and what becomes of their sizes."""

from dataclasses import replace

import numpy as np
import pytest

from app.task import row_order
from app.task.rounds import placed_estimates, placed_items
from app.task.row_order import CHANGED, CLEARLY_CHANGED, partly_hidden, with_sizes_measured
from app.task.task_types import TaskResult
from manipulation.types import ObjectOutcome
from perception.geometry import pose_from_yaw
from perception.pipeline import Perception
from perception.types import TriangleMesh

AT = pose_from_yaw(0.4, np.array([0.5, 0.25, 0.0]))


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
    return TaskResult(objects=objects, plan=plan, outcomes=outcomes)


def test_what_lay_stood_on_something_or_carried_something_was_partly_hidden(result, can_at):
    assert partly_hidden(result) == {0}
    upper = replace(can_at(2), rests_on=1)
    assert partly_hidden(replace(result, objects=[*result.objects, upper])) == {0, 1}, "it is not placed"
    placed = [*result.outcomes, ObjectOutcome(2, "can_2", True, 1, "", AT)]
    assert partly_hidden(replace(result, objects=[*result.objects, upper], outcomes=placed)) == {0, 1, 2}
    failed = [replace(outcome, placed=False) for outcome in result.outcomes]
    assert partly_hidden(replace(result, outcomes=failed)) == set()


@pytest.mark.parametrize(
    ("change", "hidden", "is_new"),
    [
        (1.2 * CHANGED, {0}, True),
        (0.8 * CHANGED, {0}, False),
        (0.9 * CLEARLY_CHANGED, {1}, False),
        (1.2 * CLEARLY_CHANGED, {1}, True),
    ],
)
def test_a_size_that_changes_is_that_of_the_object_from_then_on(
    result, networks, monkeypatch, change, hidden, is_new
):
    """Of what stood free, it changes by more."""
    asked = []

    def remeasured(estimates, frames, plane, network, decoder, ids=None):
        asked.append((set(estimates), network, decoder))
        before = estimates[0]
        height = np.sqrt((before.size + change) ** 2 - 0.07**2)
        taller = TriangleMesh(before.mesh.vertices * (1.0, 1.0, height / 0.1), before.mesh.faces)
        return {0: replace(before, mesh=taller, resting="upright")}

    monkeypatch.setattr(row_order, "remeasured", remeasured)
    measured = with_sizes_measured(result, hidden, networks, lambda places: [])
    assert asked[0] == ({0, 1}, "detector", "decoder")
    if not is_new:
        assert measured is result
        return
    now = placed_estimates(measured)[0]
    assert now.size == pytest.approx(placed_estimates(result)[0].size + change)
    assert placed_items(measured)["can_0"].size == now.size
    assert measured.objects[0].resting == "lying" and measured.objects[1] is result.objects[1]
    np.testing.assert_allclose(
        measured.objects[0].T_world_object, result.objects[0].T_world_object, atol=1e-9
    )


def test_what_no_image_of_the_rows_shows_whole_is_looked_at_from_nearby(result, networks, monkeypatch):
    """If it was partly hidden before."""
    looked, used = [], []

    def remeasured(estimates, frames, plane, network, decoder, ids=None):
        used.append((list(frames), ids))
        return {1: estimates[1]} if ids is None else {id: estimates[id] for id in ids}

    monkeypatch.setattr(row_order, "remeasured", remeasured)
    for hidden, n_used in ((set(), 1), ({1}, 1), ({0}, 2)):
        used.clear()
        with_sizes_measured(result, hidden, networks, lambda places: looked.extend(places) or ["near"])
        assert len(used) == n_used
    assert used == [([], None), (["near"], [0])] and looked == [pytest.approx(AT[:2, 3].tolist())]
