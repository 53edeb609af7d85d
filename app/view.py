"""``nodeslam view``: a run folder replayed in the browser, or a live cell; ``--html`` writes a page."""

from __future__ import annotations

import time
from pathlib import Path

from rich.markup import escape

from app.errors import UsageError
from app.options import ViewOptions
from app.report import Report
from app.screen import Screen
from app.viewer.load import Run, load_run
from app.viewer.server import open_server
from app.viewer.viewer import Viewer


def run(options: ViewOptions, screen: Screen) -> Report:
    """Serve until interrupted, or write the page."""
    if options.run is None:
        raise UsageError("view needs a run folder")
    shown = load_run(options.run)
    server = open_server(options.host, options.port)
    viewer = Viewer(server, shown.recorder)
    try:
        title_of_run(viewer, shown, options.run)
        viewer.start()
        screen.show(escape(f"{options.run} is at {server.url}; Ctrl+C ends it."))
        serve()
    finally:
        viewer.close()
    return Report("view", options.seed, success=True, reason=f"{options.run} was shown")


def serve() -> None:
    """Wait for Ctrl+C."""
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        return


def title_of_run(viewer: Viewer, shown: Run, folder: Path) -> None:
    """Say what is shown."""
    report = shown.report
    command, reason = str(report.get("command", "")), str(report.get("reason", ""))
    title = f"{command.capitalize()}, seed {report.get('seed')}" if command else folder.name
    objects = report.get("objects")
    viewer.title(title, reason or str(folder), objects if isinstance(objects, list) else [])
