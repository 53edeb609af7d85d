import sys
import types

import pytest

from app.evaluation.command import run
from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen


@pytest.mark.parametrize("subject", ["detection", "reconstruction", "slam", "tasks"])
def test_the_chosen_evaluation_runs(subject, monkeypatch):
    called = []

    def evaluate(options, screen):
        called.append((options, screen))
        return Report(f"evaluate {subject}", options.seed, success=True)

    monkeypatch.setitem(sys.modules, f"app.evaluation.{subject}", types.SimpleNamespace(run=evaluate))
    options, screen = EvaluateOptions(what=subject, seed=3), Screen(quiet=True)
    assert run(options, screen).command == f"evaluate {subject}"
    assert called == [(options, screen)]
