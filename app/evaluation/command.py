"""``nodeslam evaluate``: dispatch to the evaluation of the chosen subject."""

from __future__ import annotations

import importlib

from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Run the chosen evaluation; no module of the others is imported."""
    return importlib.import_module(f"app.evaluation.{options.what}").run(options, screen)
