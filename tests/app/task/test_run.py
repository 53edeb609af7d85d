import json
import threading

import numpy as np
import pytest
from rich.markup import escape

import app.task.run as task_run
from app.options import PackOptions, SortOptions
from app.runs.replay import Recorder
from app.runs.report import ObjectReport, Report
from app.screen import Screen
from app.task.recording import CellRecorder
from app.task.run import run_and_store, task_of
from app.task.run_control import RunControl, RunStopped
from app.task.run_writer import RunSession
from app.task.task_types import TaskResult
from perception.pipeline import Perception
from sim_assets.robots import panda


def test_task_of():
    assert task_of(PackOptions()) == "pack" and task_of(SortOptions()) == "sort"


@pytest.fixture
def session(still_world, monkeypatch):
    still_world._robot = panda()
    monkeypatch.setattr(CellRecorder, "__init__", recorder_without_cell)
    return RunSession(still_world, CellRecorder(still_world), RunControl(), Screen(quiet=True))


def recorder_without_cell(self, world):
    self.world, self.recorder, self._lock = world, Recorder(), threading.Lock()


def test_report_and_overview_are_stored(session, tmp_path, monkeypatch):
    calls = []

    def episode(world, options, task, perception, observer):
        calls.append((world, task))
        with observer.stage("scan"):
            pass
        report = Report(
            task, options.seed, True, "all in place", {"total": 1.0}, [ObjectReport(0, "can", True)],
            {"n_placed": 1, "simulated_seconds": 3.0, "reconstruction": []},
        )  # fmt: skip
        return report, TaskResult(failure="the arm [1] stopped")

    monkeypatch.setattr(task_run, "run_episode", episode)
    shown = []
    monkeypatch.setattr(session.screen, "show", shown.append)
    report = run_and_store(SortOptions(out=tmp_path, seed=9), object.__new__(Perception), session)
    assert calls == [(session.world, "sort")] and report.success
    assert escape("Ended early: the arm [1] stopped") in shown
    stored = json.loads((tmp_path / "report.json").read_text())
    assert stored["command"] == "sort" and stored["seed"] == 9 and stored["success"]
    for name in ("overview.png", "replay.npz", "replay.json"):
        assert (tmp_path / name).stat().st_size > 0
    assert session.world.observer is None  # the recording has ended


def test_a_stopped_run_keeps_its_recording(session, tmp_path, monkeypatch):
    def episode(world, options, task, perception, observer):
        observer._recording.recorder.sample(0.0, np.zeros(7), 0.0)
        raise RunStopped

    monkeypatch.setattr(task_run, "run_episode", episode)
    with pytest.raises(RunStopped):
        run_and_store(PackOptions(out=tmp_path), object.__new__(Perception), session)
    assert (tmp_path / "replay.npz").exists() and not (tmp_path / "overview.png").exists()
    assert not json.loads((tmp_path / "report.json").read_text())["success"]
