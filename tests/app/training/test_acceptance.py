"""The regression on made-up evidence, labels of masks, and the job on made-up fits."""

import json
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from app.training import acceptance
from app.training.acceptance import (
    AcceptanceTraining,
    Chunk,
    TrainAcceptanceConfig,
    _label,
    acceptance_metrics,
    collect,
    fit_model,
    logistic_regression,
    run,
    samples_of,
)
from app.workers import Lost
from perception.errors import PerceptionError
from perception.inference.acceptance import AcceptanceModel
from perception.inference.evidence import Evidence
from perception.types import CATEGORIES, ObjectDetection


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


def test_masks_are_attributed_to_the_item_they_show_most():
    instances = np.full((10, 10), -1)
    instances[:, 2:6], instances[:, 6:9] = 0, 1
    labels = (
        SimpleNamespace(category="mug", ignored=False),
        SimpleNamespace(category=None, ignored=False),
    )
    image = SimpleNamespace(instances=instances, labels=labels)

    def label(columns):
        mask = np.zeros((10, 10), bool)
        mask[:, columns] = True
        return _label(image, ObjectDetection("can", 0.5, mask))

    assert label(slice(2, 6)) == "mug" and label(slice(6, 9)) == "other"
    assert label(slice(4, 8)) == "other" and label(slice(8, 10)) == "other"  # half of each; background
    labels[0].ignored = True
    assert label(slice(2, 6)) == "ignored"


def test_finished_chunks_are_reused_and_lost_ones_reported(tmp_path, monkeypatch):
    done = Chunk(tmp_path, "train", 3, 0, acceptance.CHUNK)
    done.path.write_text(json.dumps([{"first": 1}]))
    asked = []

    def in_processes(function, chunks, workers):
        for chunk in chunks:
            asked.append((chunk.number, chunk.count))
            chunk.path.write_text(json.dumps([{"second": 2}]))
            yield chunk, None

    monkeypatch.setattr(acceptance, "map_in_processes", in_processes)
    assert collect(tmp_path, "train", acceptance.CHUNK + 5, 3) == [{"first": 1}, {"second": 2}]
    assert asked == [(1, 5)]
    monkeypatch.setattr(
        acceptance, "map_in_processes", lambda f, chunks, w: ((c, Lost("killed", 1.0)) for c in chunks)
    )
    with pytest.raises(PerceptionError, match="chunk 0 of test scenes failed: killed"):
        collect(tmp_path, "test", 5, 3)


def test_the_job_writes_coefficients_and_card(tmp_path: Path, rows, monkeypatch):
    monkeypatch.setattr(acceptance, "collect", lambda *_: rows)
    metrics = run(TrainAcceptanceConfig(), tmp_path)
    assert metrics["fits"] == len(rows)
    assert AcceptanceModel.load(tmp_path / "acceptance.json").threshold == AcceptanceTraining().threshold
    card = (tmp_path / "acceptance.md").read_text()
    assert "| mug | 60 |" in card and "SHA-256 of `acceptance.json`" in card
