"""``nodeslam view``: a run folder replayed in the browser, or a live cell; ``--html`` writes a page."""

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
from app.viewer.load import Run, load_run
from app.viewer.server import open_server
from app.viewer.viewer import Viewer

SEEDED = ("pack", "sort", "scan")  # commands whose seed decides what is seen


def run(options: ViewOptions, screen: Screen) -> Report:
    """Serve until interrupted, or write the page."""
    if options.run is None:
        if options.html is not None:
            raise UsageError("--html writes the page of a run: give its folder, view RUN --html FILE")
        return _live(options, screen)
    shown = load_run(options.run)
    if options.html is not None:
        return _write_page(options, options.html, shown, screen)
    viewer = Viewer(open_server(options.host, options.port), shown.recorder)
    try:
        show_title(viewer, shown, options.run)
        viewer.start()
        screen.show(escape(f"{options.run} is at {viewer.server.url}; Ctrl+C ends it."))
        with _until_interrupted():
            while True:
                time.sleep(3600)
    finally:
        viewer.close()
    return Report("view", options.seed, success=True, reason=f"{options.run} was shown")


@contextmanager
def watch(options: RunTaskOptions, recorder: Recorder, control: RunControl, screen: Screen) -> Iterator[None]:
    """Let the browser watch a run; when it is over the view ends with it."""
    from app.viewer.live import RunButtons

    viewer = Viewer(open_server(options.host, options.port), recorder, live=True)
    with viewer.server.gui.add_folder("Robot", order=1):
        RunButtons(viewer.server.gui, lambda: control).show(running=True)
    viewer.player.give_way(True)
    viewer.title(f"{type(options).__name__.removesuffix('Options')}, seed {options.seed}", "happening now")
    viewer.start()
    screen.show(escape(f"Watch it at {viewer.server.url}"))
    try:
        yield
    finally:
        viewer.close()


def _live(options: ViewOptions, screen: Screen) -> Report:
    from app.viewer.live import Session

    viewer = Viewer(open_server(options.host, options.port), live=True)
    try:
        session = Session(options, viewer, screen)
        viewer.start()
        screen.show(escape(f"The cell is at {viewer.server.url}; Ctrl+C ends it."))
        with _until_interrupted():
            session.serve()
    finally:
        viewer.close()
    return Report("view", options.seed, success=True, reason="the cell was shown")


def _write_page(options: ViewOptions, path: Path, shown: Run, screen: Screen) -> Report:
    from app.viewer.page import write_page

    with screen.stage(f"Writing {path}"):
        size = write_page(path, shown, *titles(shown, options.run or path))
    screen.show(escape(f"{path} ({size / 1e6:.1f} MB) opens in any browser, offline."))
    return Report("view", options.seed, success=True, reason=str(path), metrics={"bytes": size})


@contextmanager
def _until_interrupted() -> Iterator[None]:
    """Ctrl+C is how a person ends this, and no failure."""
    try:
        yield
    except KeyboardInterrupt:
        return


def show_title(viewer: Viewer, shown: Run, folder: Path) -> None:
    """Say what is shown."""
    objects = shown.report.get("objects")
    viewer.title(*titles(shown, folder), objects if isinstance(objects, list) else [])


def titles(shown: Run, folder: Path) -> tuple[str, str]:
    """Title and subtitle of a run."""
    command, reason = (str(shown.report.get(key, "")) for key in ("command", "reason"))
    if not command:
        return folder.name, reason
    name = "SLAM" if command == "slam" else command.capitalize()
    return (f"{name}, seed {shown.report.get('seed')}" if command in SEEDED else name), reason
