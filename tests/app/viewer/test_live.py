"""Buttons of a run, and the commands of a session, with a fake cell."""

from types import SimpleNamespace

import pytest

from app.options import PackOptions, SortOptions, ViewOptions
from app.runs.replay import Recorder
from app.runs.report import ObjectReport, Report
from app.screen import Screen
from app.task.run_control import RunControl, RunStopped
from app.viewer import live
from app.viewer.live import LiveSession, RunButtons, outcomes
from app.viewer.snapshot import ObjectOutcome
from app.viewer.viewer import Viewer


@pytest.fixture
def cell(server, monkeypatch):
    """A session with a fake cell: ``log`` lists scenes and runs, a run returns or raises ``result``."""
    cell = SimpleNamespace(log=[], result=Report("pack", 5, success=True, reason="1 of 1"))

    def build(options, task):
        cell.log.append(("scene", task, options.seed, options.objects))
        return SimpleNamespace(close=lambda: cell.log.append("closed"))

    def execute(options, perception, session):
        cell.log.append(("run", options.seed))
        if isinstance(cell.result, BaseException):
            raise cell.result
        return cell.result

    monkeypatch.setattr(live, "build_world", build)
    monkeypatch.setattr(live, "CellRecorder", lambda world: SimpleNamespace(recorder=Recorder()))
    monkeypatch.setattr(live, "load_perception", lambda device: None)
    monkeypatch.setattr(live, "RunSession", lambda *_: None)
    monkeypatch.setattr(live, "run_and_store", execute)
    cell.viewer = Viewer(server, live=True)
    cell.session = LiveSession(ViewOptions(objects="2", seed=5), cell.viewer, Screen(quiet=True))
    return cell


def serve(cell, *commands):
    for command in commands:
        cell.session._build_scene(5) if not cell.log else None
        cell.session._execute(command)
    return cell.viewer.panel._header.content


def test_a_new_scene_increments_an_unchanged_seed(cell):
    serve(cell, "new scene")
    assert cell.log == [("scene", "pack", 5, "2"), "closed", ("scene", "pack", 6, "2")]
    cell.session._seed.value = 9
    cell.session._count.value, cell.session._task.value = 3, "sort"
    serve(cell, "new scene")
    assert cell.log[-1] == ("scene", "sort", 9, "3")
    assert isinstance(cell.session._scene, SortOptions) and cell.session._seed.value == 9


def test_a_fresh_scene_is_used_and_a_used_one_rebuilt(cell):
    header = serve(cell, "run")
    assert cell.log == [("scene", "pack", 5, "2"), ("run", 5)] and "1 of 1" in header
    assert isinstance(cell.session._scene, PackOptions) and not cell.viewer.player.yielding
    serve(cell, "run")
    assert cell.log[2:] == ["closed", ("scene", "pack", 5, "2"), ("run", 5)]


@pytest.mark.parametrize(
    ("result", "expected"),
    [(RunStopped(), "stopped; finished results are kept"), (ValueError("no plan"), "no plan")],
)
def test_a_run_that_ends_early_is_reported_and_no_longer_yielded_to(cell, result, expected):
    cell.result = result
    assert expected in serve(cell, "run")
    assert not cell.viewer.player.yielding


def test_serving_ends_on_request_and_closes_the_cell(cell):
    cell.session._commands.put("run")
    cell.session.end()
    cell.session.serve()  # clicks during a command are merged, the end comes last
    assert cell.log == [("scene", "pack", 5, "2"), "closed"]


def test_buttons_are_enabled_during_a_run_and_name_their_action(server):
    control = RunControl()
    buttons = RunButtons(server.gui, lambda: control)
    buttons.update(running=True)
    assert buttons._pause.label == "Pause robot" and not buttons._stop.disabled
    control.pause()
    buttons.update(running=True)
    assert buttons._pause.label == "Resume robot"
    buttons.update(running=False)
    assert buttons._pause.label == "Pause robot" and buttons._stop.disabled and buttons._step.disabled


def test_outcomes_are_those_of_the_report():
    objects = (ObjectReport(2, "mug", True, 0.004), ObjectReport(3, "can"))
    report = Report("pack", 1, success=True, reason="", objects=objects)
    assert outcomes(report) == {2: ObjectOutcome(True, 0.004), 3: ObjectOutcome(False)}
