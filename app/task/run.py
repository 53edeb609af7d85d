"""Run one episode in an existing cell and store everything that it produces."""

from __future__ import annotations

from rich.markup import escape

from app.options import PackOptions, RunTaskOptions, Task
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.tables import object_table
from app.task.episode import run_episode
from app.task.run_writer import RunSession, RunWriter
from perception.pipeline import Perception


def run_and_store(options: RunTaskOptions, perception: Perception, session: RunSession) -> Report:
    """Run one episode; write report, scan, object map, plan, replay and pictures into a run folder.

    Raises:
        RunStopped: The run was stopped by a person; finished results are kept.
    """
    task, screen = task_of(options), session.screen
    with RunFolder.create(options, task) as folder:
        screen.note(f"{task}, seed {options.seed}: {folder.path}")
        writer = RunWriter(options, task, folder, session)
        try:
            report, result = run_episode(session.world, options, task, perception, writer)
        finally:
            writer.close()
        folder.write_report(report)
        with screen.stage("Drawing the overview"):
            writer.write_overview(report, result)
    screen.show(object_table(report))
    if result.failure:
        screen.show(escape(f"Ended early: {result.failure}"))
    screen.show(escape(f"Summary: {folder.path / 'overview.png'}; details: report.json"))
    return report


def task_of(options: RunTaskOptions) -> Task:
    """Return the task that the options belong to."""
    return "pack" if isinstance(options, PackOptions) else "sort"
