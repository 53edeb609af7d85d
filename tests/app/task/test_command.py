from contextlib import contextmanager

import pytest

import app.task.command as command
from app.options import PackOptions, SortOptions
from app.runs.report import Report
from app.screen import Screen
from perception.pipeline import Perception
from sim_assets.cell.world import World


@pytest.fixture
def calls(monkeypatch, still_world):
    """Replaces cell, networks and episode; records the calls."""
    made = []
    still_world.close = lambda: made.append("closed")
    perception = object.__new__(Perception)

    def build(options, task):
        made.append(("cell", task))
        return still_world

    def store(options, given, session):
        made.append(("episode", given is perception, session.world is still_world))
        return Report("pack", options.seed, success=True)

    monkeypatch.setattr(command, "build_world", build)
    monkeypatch.setattr(command.CellRecorder, "__init__", lambda self, world: setattr(self, "recorder", None))
    monkeypatch.setattr(
        command, "load_perception", lambda device: made.append(("networks", device)) or perception
    )
    monkeypatch.setattr(command, "run_and_store", store)
    return made


@pytest.mark.parametrize(("kind", "task"), [(PackOptions, "pack"), (SortOptions, "sort")])
def test_one_episode_in_a_cell_that_is_closed_afterwards(calls, kind, task):
    assert command.run(kind(device="cpu"), Screen(quiet=True)).success
    assert calls == [("cell", task), ("networks", "cpu"), ("episode", True, True), "closed"]


def test_the_viewer_is_open_during_the_episode(calls, monkeypatch):
    @contextmanager
    def watch(options, recorder, control, screen):
        calls.append("opened")
        yield
        calls.append("viewer closed")

    monkeypatch.setattr("app.viewer.command.watch", watch)
    command.run(PackOptions(view=True), Screen(quiet=True))
    assert [call for call in calls if isinstance(call, str)] == ["opened", "viewer closed", "closed"]
    assert calls.index("opened") < calls.index(("episode", True, True)) < calls.index("viewer closed")


def test_a_cell_is_a_context_manager():
    assert hasattr(World, "__enter__") and hasattr(World, "__exit__")
