"""``nodeslam doctor --robot``: everything about an arm in one table, with a remedy for each finding."""

from __future__ import annotations

import time
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from app.options import DoctorOptions
from app.robots.draft import draft_robot
from app.robots.examination import Examination, examine_robot
from app.robots.picture import write_picture
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.task.cell import load_arm

PICTURE = "robot.png"
_MARKS = {"good": "[green]✓[/green]", "warning": "[yellow]–[/yellow]", "fault": "[red]✗[/red]"}


def run_robot_doctor(options: DoctorOptions, spec: str, screen: Screen) -> Report:
    """Examine an arm given by name, robot file or MJCF; for an MJCF, a robot file is drafted first.

    Raises:
        ProblemsError: the robot file does not fit its models; lists all problems.
        UsageError: no robot file can be drafted from the MJCF.
    """
    begin = time.perf_counter()
    robot = None if Path(spec).suffix == ".xml" else load_arm(spec, check=False)
    with RunFolder.create(options, "doctor") as folder:
        if robot is None:
            with screen.stage("Drafting a robot file"):
                draft = draft_robot(Path(spec), folder.path)
            file = folder.path / "robot.toml"
            file.write_text(draft.text, encoding="utf-8")
            robot = load_arm(str(file), check=False)
        with screen.stage("Examining the arm"):
            examination = examine_robot(robot)
        write_picture(folder.path / PICTURE, robot, examination)
        report = _report(options, examination, time.perf_counter() - begin)
        folder.write_report(report)
    screen.show(_table(examination))
    screen.show(escape(f"{report.reason}; picture: {folder.path / PICTURE}"))
    return report


def _report(options: DoctorOptions, examination: Examination, seconds: float) -> Report:
    faults = [finding for finding in examination.findings if finding.verdict == "fault"]
    warnings = [finding for finding in examination.findings if finding.verdict == "warning"]
    return Report(
        command="doctor",
        seed=options.seed,
        success=not faults,
        reason=f"{len(faults)} faults, {len(warnings)} warnings",
        timings={"total": seconds},
        metrics={"findings": [vars(finding) for finding in examination.findings]},
    )


def _table(examination: Examination) -> Table:
    table = Table(title="nodeslam doctor --robot", title_justify="left", show_edge=False)
    for heading in ("", "what", "found", "what to do"):
        table.add_column(heading)
    for finding in examination.findings:
        remedy = finding.remedy if finding.verdict != "good" else ""
        row = (escape(text) for text in (finding.subject, finding.found, remedy))
        table.add_row(_MARKS[finding.verdict], *row)
    return table
