"""``nodeslam pack`` and ``nodeslam sort``: one episode in the simulated cell, stored, drawn and scored."""

from __future__ import annotations

import contextlib

from app.options import RunTaskOptions
from app.runs.report import Report
from app.runs.rerun_log import require_rerun
from app.screen import Screen
from app.task.cell import build_world
from app.task.recording import CellRecorder
from app.task.run import run_and_store, task_of
from app.task.run_control import RunControl
from app.task.run_writer import RunSession
from perception.pipeline import load_perception


def run(options: RunTaskOptions, screen: Screen) -> Report:
    """Build a cell and run one episode in it, or run it with the robot behind ``--connect``."""
    if options.connect:
        from app.task.remote import run as run_remote

        return run_remote(options, task_of(options), screen)
    if options.log == "rerun":
        require_rerun()
    with screen.stage("Building the cell"):
        world = build_world(options, task_of(options))
    with world, contextlib.ExitStack() as stack:
        session = RunSession(world, CellRecorder(world), RunControl(), screen)
        if options.view:
            from app.viewer.command import watch

            stack.enter_context(watch(options, session.recording.recorder, session.control, screen))
        with screen.stage("Loading networks"):
            perception = load_perception(options.device)
        return run_and_store(options, perception, session)
