"""Options of one evaluation, of the comparison and of growth, where they have no effect."""

from dataclasses import fields
from pathlib import Path

import pytest

from app.options import BenchOptions, CommonOptions, EvaluateOptions
from app.options.experiments import OPTIONS_OF


@pytest.mark.parametrize(
    ("options", "ignored"),
    [
        (EvaluateOptions(what="slam", episodes=3), {"episodes": "on `evaluate slam`"}),
        (EvaluateOptions(what="slam", scenes=2, depth_noise="kinect", workers=2), {}),
        (EvaluateOptions(what="detection", clutter=True), {"clutter": "on `evaluate detection`"}),
        (EvaluateOptions(what="detection", rooms=True, object_meshes=Path("meshes")), {}),
        (EvaluateOptions(what="reconstruction", images=3), {"images": "on `evaluate reconstruction`"}),
        (EvaluateOptions(what="reconstruction", objects="mug=2", masks="given", resume=True), {}),
        (EvaluateOptions(what="tasks", views=(1,)), {"views": "on `evaluate tasks`"}),
        (EvaluateOptions(what="tasks", task="sort", clutter=True, episodes=3, seed=2), {}),
        (BenchOptions(growth_workers=(1,)), {"growth_workers": "without --growth"}),
        (BenchOptions(growth_workers=(1,), growth=True), {}),
        (BenchOptions(tolerance=0.5), {"tolerance": "without --against"}),
        (BenchOptions(tolerance=0.5, against=Path("report.json")), {}),
    ],
)
def test_options_without_effect(options: CommonOptions, ignored: dict[str, str]):
    reasons = options.without_effect().items()
    assert {name: why for why, names in reasons for name in options.changed().intersection(names)} == ignored


def test_every_evaluation_names_options_that_exist():
    names = {field.name for field in fields(EvaluateOptions)}
    assert set().union(*OPTIONS_OF.values()) <= names
    assert {"detection", "reconstruction", "slam", "tasks"} == set(OPTIONS_OF)
