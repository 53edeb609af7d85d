"""The regression on made-up evidence, and the job on made-up fits."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from app.training import acceptance
from app.training.acceptance import (
    AcceptanceTraining,
    TrainAcceptanceConfig,
    acceptance_metrics,
    fit_model,
    logistic_regression,
    run,
    samples_of,
)
from perception.errors import PerceptionError
from perception.inference.acceptance import AcceptanceModel
from perception.inference.evidence import Evidence
from perception.types import CATEGORIES


def row(category, real, rng, rank=0):
    """A fit: real ones explain their mask, the others have free space behind them."""
    noise = {f.name: float(rng.uniform(0.2, 0.3)) for f in fields(Evidence)}
    violated = float(rng.uniform(0.0, 0.1) if real else rng.uniform(0.05, 0.5))
    evidence = noise | {"free_space": violated, "height": float(rng.uniform(0.08, 0.12))}
    p = float(np.clip(rng.normal(0.8 if real else 0.4, 0.2), 0.01, 0.99))
    return {
        "category": category, "rank": rank, "real": bool(real), "label": "other", "probability": p,
        "evidence": evidence,
    }  # fmt: skip


@pytest.fixture(scope="module")
def rows():
    rng = np.random.default_rng(0)
    return [row(c, k % 2, rng) for k in range(120) for c in CATEGORIES]


def test_the_regression_finds_the_log_odds_of_counts():
    """Of the inputs 0 three quarters are positive, of the inputs 1 a quarter; the first term is AGAINST."""
    x = np.column_stack([np.ones(400), np.repeat([0.0, 1.0], 200)])
    y = np.tile([True, True, True, False], 50)
    y = np.concatenate([y, ~y])
    weights = logistic_regression(x, y, 1e-9)
    np.testing.assert_allclose(weights, [np.log(3), -2 * np.log(3)], atol=1e-3)
    assert abs(logistic_regression(x, y, 100.0)[1]) < 1.0  # the penalty
    drawn = logistic_regression(x, y, 1e6, np.array([0.0, -0.7]))
    assert drawn[1] == pytest.approx(-0.7, abs=1e-3)
    np.testing.assert_allclose(logistic_regression(x, ~y, 1e-9), [0.0, 0.0], atol=1e-3)  # never in favour


def test_the_model_separates_the_fits_and_is_calibrated(rows):
    model = fit_model(rows, AcceptanceTraining(ridge=1.0))
    test_rng = np.random.default_rng(1)
    test = [row(c, k % 2, test_rng) for k in range(60) for c in CATEGORIES]
    metrics = acceptance_metrics(model, test)
    assert metrics["fits"] == 240 and metrics["calibration_error"] < 0.12
    for figures in metrics["classes"].values():
        assert figures["objects"] == figures["others"] == 30
        assert figures["objects_accepted"] > 0.85 and figures["others_accepted"] < 0.25


def test_same_seed_same_model(rows):
    one, two = (fit_model(rows, AcceptanceTraining(seed=4)) for _ in range(2))
    np.testing.assert_array_equal(one.classes["mug"].weights, two.classes["mug"].weights)


def test_too_few_fits_of_a_class_are_an_error(rows):
    assert len(samples_of(rows, "can").real) == 120
    with pytest.raises(PerceptionError, match="render more images"):
        fit_model(rows[:16], AcceptanceTraining())


def test_the_job_writes_coefficients_and_card(tmp_path: Path, rows, monkeypatch):
    monkeypatch.setattr(acceptance, "collect", lambda *_: rows)
    metrics = run(TrainAcceptanceConfig(), tmp_path)
    assert metrics["fits"] == len(rows)
    assert AcceptanceModel.load(tmp_path / "acceptance.json").threshold == AcceptanceTraining().threshold
    card = (tmp_path / "acceptance.md").read_text()
    assert "| mug | 60 |" in card and "SHA-256 of `acceptance.json`" in card
