"""Planning is timed for every object that fits, with the arm at rest."""

import pytest

from app.benchmarks import growth_planning
from app.benchmarks.growth_planning import planning_times
from app.task.task_types import TaskResult
from manipulation.planning_scene import PlanningScene
from perception.pipeline import load_perception


@pytest.fixture(scope="module")
def networks():
    return load_perception("cpu")


def test_each_placed_object_has_a_time_and_blocks_the_next(networks, monkeypatch, can_at):
    cans = [can_at(0, 0.45, -0.2), can_at(1, 0.45, -0.32), can_at(2, 1.6, -0.2)]  # the last one out of reach
    monkeypatch.setattr(growth_planning, "run_pipeline", lambda *args: TaskResult(objects=cans))
    moved = []
    real = PlanningScene.moved
    monkeypatch.setattr(
        PlanningScene,
        "moved",
        lambda self, name, T: (moved.append((name, round(float(T[1, 3]), 1))), real(self, name, T)),
    )
    times = planning_times(networks, 2, 0)
    assert len(times.objects) == 2 and min(times.objects) > 0.0 and times.layout > 0.0
    assert sorted(name for name, _ in moved) == ["can_0", "can_1"]
    assert all(y > 0.1 for _, y in moved)  # in the box


def test_an_object_without_a_plan_has_a_time_too(networks, monkeypatch, can_at):
    monkeypatch.setattr(growth_planning, "run_pipeline", lambda *args: TaskResult(objects=[can_at(0)]))

    def fail(self, placement, q):
        raise growth_planning.NoPlanError("no plan", ())

    monkeypatch.setattr(growth_planning.PickPlacePlanner, "plan", fail)
    monkeypatch.setattr(PlanningScene, "moved", lambda *args: pytest.fail("moved"))
    assert len(planning_times(networks, 1, 0).objects) == 1
