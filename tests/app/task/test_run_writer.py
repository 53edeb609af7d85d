"""Content of the run folder at each moment of a run."""

import json
import threading

import pytest

from app.options import PackOptions
from app.runs.replay import Recorder, read_recording
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.task.recording import CellRecorder
from app.task.run_control import RunControl, RunStopped
from app.task.run_writer import RunSession, RunWriter, plan_as_json, subtitle_of
from perception.io.scan_folder import read_scan


class StillRecorder(CellRecorder):
    """Records a cell in which nothing moves."""

    def __init__(self, world):
        self.world, self.recorder, self._lock = world, Recorder(), threading.Lock()

    def sample(self):
        pass


@pytest.fixture
def writer_of(tmp_path, still_world):
    def create(control=None):
        options = PackOptions(out=tmp_path / "run", seed=4)
        folder = RunFolder.create(options, "pack")
        session = RunSession(
            still_world, StillRecorder(still_world), control or RunControl(), Screen(quiet=True)
        )
        return RunWriter(options, "pack", folder, session), folder

    return create


def test_an_interrupted_run_keeps_finished_stages(writer_of, overhead_frame):
    writer, folder = writer_of()
    with writer.stage("scan"):
        writer.on_frames([overhead_frame])
    with pytest.raises(KeyboardInterrupt), writer.stage("detect"):
        report = json.loads((folder.path / "report.json").read_text())
        assert report["reason"] == "stopped while detecting objects" and "scan" in report["timings"]
        raise KeyboardInterrupt
    writer.close()
    assert len(read_scan(folder.scan).frames) == 1
    replay = read_recording(folder.path)
    assert [note.data["name"] for note in replay.notes if note.kind == "stage"] == ["scan", "detect"]


def test_pauses_do_not_count_as_time_of_a_stage(writer_of):
    control = RunControl()
    writer, _ = writer_of(control)
    with writer.stage("plan"):
        control.paused_seconds += 100.0
    assert -100.0 < writer.timings["plan"] < -99.0  # measured time less the claimed pause


def test_a_stopped_run_ends_at_the_next_sample(writer_of, still_world):
    control = RunControl()
    writer_of(control)
    still_world.observer(still_world)
    control.stop()
    with pytest.raises(RunStopped):
        still_world.observer(still_world)


def test_plan_json(pack_plan):
    assert plan_as_json(pack_plan) == {
        "task": "pack",
        "placements": [
            {
                "name": "can_0",
                "from": pytest.approx([0.4, -0.2, 0.0]),
                "position": [0.5, 0.27, 0.004],
                "yaws": [0.0],
                "stack": [],
            }
        ],
        "left_out": {"can_1": "too far"},
    }


@pytest.mark.parametrize(("success", "verdict"), [(True, "done"), (False, "not done")])
def test_subtitle_has_the_times_of_the_episode(success, verdict):
    timings = {"scan": 10.0, "execute": 11.0, "total": 31.6}
    report = Report("pack", 7, success, timings=timings, metrics={"simulated_seconds": 64.4})
    assert subtitle_of(report) == f"{verdict} · seed 7 · 32 s wall, 64 s robot time"


def test_subtitle_says_that_a_thing_of_no_class_was_moved():
    metrics = {"simulated_seconds": 64.4, "unknown": [{"moved": True}]}
    report = Report("pack", 7, timings={"total": 31.6}, metrics=metrics)
    assert subtitle_of(report).startswith("not done, 1 thing of no class moved · seed 7")
