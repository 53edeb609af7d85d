"""Training on artificial fits: what can be learned, repeatability, files and messages."""

from dataclasses import fields, replace

import numpy as np
import pytest

from app.training import verifier as job
from app.training.verifier import (
    TrainVerifierConfig,
    VerifierTraining,
    inputs_of,
    train_verifier,
)
from perception.errors import PerceptionError
from perception.inference.acceptance import LINEAR, AcceptanceModel
from perception.inference.evidence import Evidence
from perception.inference.verifier import N_CONTEXT, Verifier
from perception.types import CATEGORIES, OTHER

TYPICAL = {f.name: 0.5 for f in fields(Evidence)} | {"height": 0.1, "radius": 0.04}


def row(category="can", share=0.8, label="can", **evidence):
    p = np.full(OTHER + 1, (1 - share) / OTHER)
    p[CATEGORIES.index(category)] = share
    return {
        "category": category, "rank": 0, "real": label == category, "label": label, "probability": share,
        "probabilities": p.tolist(), "evidence": TYPICAL | evidence,
    }  # fmt: skip


def exclusive_or(count, seed):
    """Two numbers whose product decides, which no sum of them does, with one of the class probabilities."""
    rng = np.random.default_rng(seed)
    x = np.zeros((count, len(LINEAR) + N_CONTEXT))
    x[:, :2] = rng.choice([-1.0, 1.0], (count, 2))
    return x, x[:, 0] * x[:, 1] > 0


def test_products_of_numbers_are_learned():
    training = VerifierTraining(epochs=30)
    network = train_verifier(*exclusive_or(2000, 0), training)
    x, real = exclusive_or(50, 1)
    scores = np.array([network.score(one) for one in x])
    assert ((scores > 0.5) == real).all() and network.threshold == training.threshold
    again = train_verifier(*exclusive_or(2000, 0), training)
    np.testing.assert_array_equal(network.hidden_weight, again.hidden_weight)
    other = train_verifier(*exclusive_or(2000, 0), replace(training, seed=1))
    assert np.abs(network.hidden_weight - other.hidden_weight).max() > 0.01


def test_few_fits_are_no_training_set():
    with pytest.raises(PerceptionError, match="100 fits are fewer than a batch of 128: render more images"):
        train_verifier(*exclusive_or(100, 0), VerifierTraining())


def test_inputs_are_those_of_the_pipeline():
    model, one = AcceptanceModel.load(), row(base=0.7)
    x = inputs_of([one], model)
    expected = model.verifier_inputs(Evidence(**one["evidence"]), "can", np.array(one["probabilities"]))
    np.testing.assert_array_equal(x, [expected])
    with pytest.raises(PerceptionError, match="lack class probabilities; train into another folder"):
        inputs_of([{k: v for k, v in one.items() if k != "probabilities"}], model)


def test_class_probabilities_are_disturbed_or_left_out_together():
    import torch

    torch.manual_seed(0)
    x = torch.ones(4000, len(LINEAR) + N_CONTEXT)
    training = VerifierTraining()
    noisy = job._disturbed(x, training).numpy()
    own = len(LINEAR) + np.arange(OTHER + 2)
    assert (np.delete(noisy, own, axis=1) == 1).all()
    unknown = (noisy[:, own] == 0).all(axis=1)
    assert unknown.mean() == pytest.approx(training.class_dropout, abs=0.03)
    known = noisy[~unknown][:, own]
    assert np.ptp(known, axis=1).max() < 1e-6  # one shift for all of them
    assert known[:, 0].std() == pytest.approx(training.class_noise / 3, rel=0.1)


def test_the_job_writes_network_and_card(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    rows = [
        row(category, share, category if share > 0.5 else "other", base=base)
        for category in CATEGORIES
        for share, base in rng.random((60, 2)).tolist()
    ]
    asked = []

    def collect(folder, split, pictures, seed, workers, progress):
        asked.append((split, pictures, seed))
        return rows

    monkeypatch.setattr(job, "collect", collect)
    config = TrainVerifierConfig(pictures=40, test=20, training=VerifierTraining(seed=5, epochs=2))
    metrics = job.run(config, tmp_path)
    assert asked == [("train", 40, 5), ("test", 20, 5)]
    assert metrics["fits"] == metrics["logistic"]["fits"] == len(rows)
    network = Verifier.load(len(LINEAR), tmp_path / "verifier.safetensors")
    assert network.threshold == config.training.threshold
    card = (tmp_path / "verifier.md").read_text()
    assert "`nodeslam train verifier --seed 5`: 40 scenes" in card and "240 fits" in card
    assert card.count("| mug |") == 2
