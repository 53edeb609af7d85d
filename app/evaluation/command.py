"""``nodeslam evaluate``: what to measure decides who does it."""

from __future__ import annotations

import importlib

from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Hand over to the evaluation that was asked for; only its modules are loaded."""
    return importlib.import_module(f"app.evaluation.{options.what}").run(options, screen)
