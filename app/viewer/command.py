"""``nodeslam view``: replay of a run or a live cell in the browser; with ``--html``, a standalone page."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.markup import escape

from app.errors import UsageError
from app.options import RunTaskOptions, ViewOptions
from app.runs.replay import Recorder
from app.runs.report import Report
from app.screen import Screen
from app.task.run_control import RunControl
from app.viewer.load import LoadedRun, load_run
from app.viewer.server import open_server
from app.viewer.viewer import Viewer

SEEDED_COMMANDS = ("pack", "sort", "scan")  # commands whose seed defines the scene


def run(options: ViewOptions, screen: Screen) -> Report:
    """Serve a replay or a live cell until interrupted, or write the page of a run."""
    if options.run is None:
        if options.html is not None:
            raise UsageError("--html writes the page of a run: give its folder, view RUN --html FILE")
        return _serve_cell(options, screen)
    if options.html is not None and options.html.is_dir():
        raise UsageError(f"--html {options.html} is a folder: give a file, such as page.html")
    loaded = load_run(options.run)
    if options.html is not None:
        return _write_page(options, options.run, options.html, loaded, screen)
    return _serve_replay(options, options.run, loaded, screen)


@contextmanager
def watch(options: RunTaskOptions, recorder: Recorder, control: RunControl, screen: Screen) -> Iterator[None]:
    """Show a run in the browser while it is executed; the viewer closes when the run ends."""
    from app.viewer.live import RunButtons

    viewer = Viewer(open_server(options.host, options.port), recorder, live=True)
    try:
        with viewer.server.gui.add_folder("Robot", order=1):
            RunButtons(viewer.server.gui, lambda: control).update(running=True)
        viewer.player.set_yielding(True)
        viewer.set_title(f"{type(options).__name__.removesuffix('Options')}, seed {options.seed}", "running")
        viewer.start()
        screen.show(escape(f"Watch the run at {viewer.server.url}"))
        yield
    finally:
        viewer.close()


def titles(loaded: LoadedRun, folder: Path) -> tuple[str, str]:
    """Return title and subtitle of a run."""
    summary = loaded.summary
    if not summary.command:
        return folder.name, summary.reason
    name = "SLAM" if summary.command == "slam" else summary.command.capitalize()
    seeded = summary.command in SEEDED_COMMANDS
    return (f"{name}, seed {summary.seed}" if seeded else name), summary.reason


def _serve_replay(options: ViewOptions, folder: Path, loaded: LoadedRun, screen: Screen) -> Report:
    viewer = Viewer(open_server(options.host, options.port), loaded.recorder)
    try:
        viewer.set_title(*titles(loaded, folder), loaded.summary.outcomes)
        viewer.start()
        screen.show(escape(f"{folder} is shown at {viewer.server.url}; stop with Ctrl+C."))
        with _until_interrupted():
            while True:
                time.sleep(3600)
    finally:
        viewer.close()
    return Report("view", options.seed, success=True, reason=f"{folder} was shown")


def _serve_cell(options: ViewOptions, screen: Screen) -> Report:
    from app.viewer.live import LiveSession

    viewer = Viewer(open_server(options.host, options.port), live=True)
    try:
        session = LiveSession(options, viewer, screen)
        viewer.start()
        screen.show(escape(f"The cell is shown at {viewer.server.url}; stop with Ctrl+C."))
        with _until_interrupted():
            session.serve()
    finally:
        viewer.close()
    return Report("view", options.seed, success=True, reason="the cell was shown")


def _write_page(options: ViewOptions, folder: Path, path: Path, loaded: LoadedRun, screen: Screen) -> Report:
    from app.viewer.page import is_page, write_page

    if path.exists() and not is_page(path):
        raise UsageError(f"--html {path} exists and is no page of this program: give another file")
    if not path.parent.is_dir():
        raise UsageError(f"--html {path}: {path.parent} is no folder: create it, or give another file")
    with screen.stage(f"Writing {path}"):
        size = write_page(path, loaded, *titles(loaded, folder))
    screen.show(escape(f"{path} ({size / 1e6:.1f} MB) opens in any browser, offline."))
    return Report("view", options.seed, success=True, reason=str(path), metrics={"bytes": size})


@contextmanager
def _until_interrupted() -> Iterator[None]:
    """Return normally on Ctrl+C, the only way to stop serving."""
    try:
        yield
    except KeyboardInterrupt:
        return
