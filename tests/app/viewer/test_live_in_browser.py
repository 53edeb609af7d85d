"""The buttons of a live run: with a simulated run, and, slowly, with a real one."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

import app.viewer.live
from app.options import ViewOptions
from app.runs.replay import Recorder
from app.runs.report import Report
from app.screen import Screen
from app.viewer.live import LiveSession
from app.viewer.server import open_server
from app.viewer.viewer import Viewer

PAUSE = ["Pause robot", "Resume robot"]
CLICK = """async ([from, to]) => {
  const named = name => [...document.querySelectorAll("button")].find(b => b.innerText.trim() === name);
  const begin = performance.now();
  named(from).click();
  while (!named(to)) await new Promise(done => setTimeout(done, 5));
  return performance.now() - begin;
}"""
MAY_END = threading.Event()  # the stages of a simulated run last until it is set


class FakeRecording:
    """Recording of a cell in which only time passes."""

    def __init__(self, world):
        self.recorder = Recorder(bodies=("tcp",))
        self.recorder.sample(0.0, np.zeros(7), 0.0, np.array([[0.4, 0, 0.3, 1, 0, 0, 0.0]]))


class FakeSession:
    def __init__(self, world, recording, control, screen):
        self.recording, self.control = recording, control


def fake_run(options, perception, session):
    recorder, control = session.recording.recorder, session.control
    for stage in ("scan", "execute"):
        recorder.note("stage", name=stage)
        control.enter_step()
        while True:
            pose = np.array([[0.4, 0.0, 0.3, 1, 0, 0, 0.0]])
            recorder.sample(recorder.times[-1] + 0.03, np.zeros(7), 0.0, pose)
            ends = MAY_END.is_set()  # before the wait: a pause holds a stage that may end, too
            control.wait_if_paused()
            if ends:
                break
            time.sleep(0.01)
        recorder.note("done", name=stage, seconds=1.5)
    return Report(options_name(options), options.seed, success=True, reason="all placed")


def options_name(options):
    return type(options).__name__.removesuffix("Options").lower()


@pytest.fixture
def session(monkeypatch):
    built = []
    MAY_END.clear()
    monkeypatch.setattr(
        app.viewer.live,
        "build_world",
        lambda options, task: built.append((task, options.seed)) or SimpleNamespace(close=lambda: None),
    )
    monkeypatch.setattr(app.viewer.live, "CellRecorder", FakeRecording)
    monkeypatch.setattr(app.viewer.live, "load_perception", lambda device: None)
    monkeypatch.setattr(app.viewer.live, "RunSession", FakeSession)
    monkeypatch.setattr(app.viewer.live, "run_and_store", fake_run)
    viewer = Viewer(open_server(port=0), live=True)
    session = LiveSession(ViewOptions(objects="2", seed=5), viewer, Screen(quiet=True))
    viewer.start()
    threading.Thread(target=session.serve, daemon=True).start()
    yield SimpleNamespace(viewer=viewer, session=session, built=built)
    viewer.close()


def test_new_scene_run_pause_step_and_stop(session, open_page, until):
    page = open_page(session.viewer.server.url)
    button = lambda name: page.page.get_by_role("button", name=name, exact=True)  # noqa: E731
    page.page.get_by_text("ready: press Run").wait_for()
    button("New scene").click()
    until(lambda: session.built == [("pack", 5), ("pack", 6)])  # an unchanged seed is incremented
    button("Run").click()
    page.page.get_by_text("running", exact=True).wait_for()
    control = session.session._control
    stages = lambda: [note for note in session.viewer.player.timeline.recorder.notes if note.kind == "stage"]  # noqa: E731
    for _ in range(3):
        page.page.evaluate(CLICK, PAUSE)
        assert control.paused
        page.page.evaluate(CLICK, PAUSE[::-1])
        assert not control.paused
    control.pause()
    MAY_END.set()
    assert len(stages()) == 1
    button("Step").click()
    until(lambda: len(stages()) == 2 and control.paused)  # to the beginning of the next stage
    control.resume()
    page.page.get_by_text("all placed").wait_for()
    MAY_END.clear()
    button("Run").click()  # rebuilds the used scene
    until(lambda: len(session.built) == 3 and session.session._control is not control)
    button("Stop").click()
    page.page.get_by_text("stopped; finished results are kept").wait_for()
    assert session.built[-1] == ("pack", 6)
    assert page.problems == []


def test_a_scene_that_cannot_be_built_is_reported_and_the_next_one_works(session, monkeypatch, until):
    def fail(options, task):
        raise ValueError("10 objects do not fit")

    until(lambda: len(session.built) == 1)
    with monkeypatch.context() as patched:
        patched.setattr(app.viewer.live, "build_world", fail)
        session.session._commands.put("new scene")
        until(lambda: "10 objects do not fit" in session.viewer.panel._header.content)
    MAY_END.set()
    session.session._commands.put("run")
    until(lambda: "all placed" in session.viewer.panel._header.content)


@pytest.mark.slow
def test_a_real_packing_episode_plays_to_its_end_in_the_browser(open_page, tmp_path, until):
    viewer = Viewer(open_server(port=0), live=True)
    options = ViewOptions(objects="can=1", shapes="oracle", seed=1, out=tmp_path / "run")
    session = LiveSession(options, viewer, Screen(quiet=True))
    viewer.start()

    def click():
        page = open_page(viewer.server.url)
        page.page.get_by_text("ready: press Run").wait_for()
        page.page.get_by_role("button", name="Run", exact=True).click()
        return page

    # The simulator belongs to one thread, the browser's driver to another: this one.
    cell = threading.Thread(target=session.serve, daemon=True)
    cell.start()
    page = click()
    page.page.get_by_text("running", exact=True).wait_for()
    done, times = page.page.get_by_text("1 of 1 objects in place"), []
    while not done.is_visible():
        for labels in (PAUSE, PAUSE[::-1]):  # at any point of the run
            times.append(page.page.evaluate(CLICK, labels))
        page.page.wait_for_timeout(500)
    assert len(times) > 10 and np.percentile(times, 90) < 300  # [ms]
    until(lambda: viewer.player.time == viewer.player.timeline.end)
    assert [span.name for span in viewer.player.timeline.stages][-1] == "verify"
    assert page.problems == []
    session.end()  # graphics are freed in the thread that made them
    cell.join(60)
    viewer.close()
