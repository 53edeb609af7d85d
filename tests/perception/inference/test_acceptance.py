"""Scores by hand-computed log odds; files; reasons."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from perception.errors import PerceptionError
from perception.inference.acceptance import (
    AGAINST,
    COEFFICIENTS,
    IN_FAVOUR,
    LINEAR,
    AcceptanceModel,
    ClassModel,
    numbers_of,
    shipped_acceptance,
    terms,
)
from perception.inference.evidence import Evidence
from perception.types import CATEGORIES

TYPICAL = Evidence(**({f.name: 0.5 for f in fields(Evidence)} | {"height": 0.1, "radius": 0.04}))


def model(bias: float = 0.0, **weights: float) -> AcceptanceModel:
    vector = np.array([weights.get(name, 0.0) for name in COEFFICIENTS])
    one = ClassModel(numbers_of(TYPICAL), np.ones(len(LINEAR)), vector, bias)
    return AcceptanceModel(dict.fromkeys(CATEGORIES, one))


def sigmoid(x: float) -> float:
    return float(1 / (1 + np.exp(-x)))


def test_a_typical_object_has_the_odds_of_the_bias() -> None:
    assert model(1.5, free_space=-3.0).score(TYPICAL, "can") == pytest.approx(sigmoid(1.5))


def test_numbers_count_in_standard_deviations_up_to_a_limit() -> None:
    judged = model(box=2.0)
    assert judged.score(replace(TYPICAL, box=1.0), "mug") == pytest.approx(sigmoid(2.0 * 0.5))
    assert judged.score(replace(TYPICAL, box=99.0), "mug") == pytest.approx(sigmoid(2.0 * 4))


def test_deviations_of_sizes_count_in_both_directions() -> None:
    judged = model(**{"height^2": -1.0})
    for factor in (0.5, 2.0):
        score = judged.score(replace(TYPICAL, height=0.1 * factor), "can")
        assert score == pytest.approx(sigmoid(-(np.log(2) ** 2)))


def test_the_class_probability_adds_its_log_odds_if_it_is_known() -> None:
    judged = model(class_logit=0.5, class_known=0.25)
    assert judged.score(TYPICAL, "can") == pytest.approx(0.5)
    assert judged.score(TYPICAL, "can", 0.8) == pytest.approx(sigmoid(0.5 * np.log(4) + 0.25))
    assert judged.score(TYPICAL, "can", 1.0) == pytest.approx(sigmoid(0.5 * np.log(99) + 0.25))


def test_existence_is_the_score_with_the_probability_of_all_classes() -> None:
    judged = model(bias=-0.3, class_logit=0.5)
    p = np.array([0.0, 0.0, 0.3, 0.5, 0.2])
    bottle = judged.score(TYPICAL, "bottle", 0.3)
    assert judged.existence(bottle, "bottle", p) == pytest.approx(judged.score(TYPICAL, "bottle", 0.8))
    assert judged.existence(1.0, "bottle", p) <= 1.0 and judged.existence(0.0, "bottle", p) < 1e-6


def test_the_terms_match_their_names() -> None:
    values = terms(numbers_of(TYPICAL), np.zeros(len(LINEAR)), np.ones(len(LINEAR)), 0.3)
    assert values.shape == (len(COEFFICIENTS),) and np.isfinite(values).all()


def test_reasons_name_the_strongest_evidence_first() -> None:
    judged = model(neck=-2.0, truncated=-4.0, code=-0.1)
    against = replace(TYPICAL, neck=1.0, truncated=1.0, code=1.0)
    assert judged.reason(against, "can") == "the image border truncates it, its upper part is unusual"
    assert judged.reason(TYPICAL, "can") == "the evidence is weak"


def test_files_round_trip(tmp_path) -> None:
    sent = model(1.0, neck=-2.0, **{"height^2": 0.5})
    sent.save(tmp_path / "mine.json")
    got = AcceptanceModel.load(tmp_path / "mine.json")
    assert got.threshold == sent.threshold
    assert got.score(TYPICAL, "bowl", 0.4) == pytest.approx(sent.score(TYPICAL, "bowl", 0.4), abs=1e-4)
    content = json.loads((tmp_path / "mine.json").read_text())
    del content["mug"]["weights"]["neck"]
    (tmp_path / "mine.json").write_text(json.dumps(content))
    with pytest.raises(PerceptionError, match=r"mine\.json holds no acceptance model"):
        AcceptanceModel.load(tmp_path / "mine.json")


def test_the_shipped_model_is_plausible() -> None:
    shipped = shipped_acceptance()
    for category, judged in shipped.classes.items():
        good = {"explained": 0.98, "uncovered": 0.0, "in_front": 0.01, "behind": 0.0, "free_space": 0.0}
        means = dict(zip(LINEAR, judged.mean.tolist()))
        size = {"height": float(np.exp(means["height"])), "radius": float(np.exp(means["radius"]))}
        shape = {name: means[name] for name in ("neck", "box", "code", "aspect", "truncated")}
        rest = {"residual": 0.8, "systematic": 0.9, "missing": 0.05, "base": 0.05, "pixels": 6000.0}
        seen = Evidence(**good, **rest, **size, **shape, section=0.01, converged=1.0)
        bad = replace(seen, free_space=0.5, uncovered=0.2, in_front=0.3, systematic=5.0, residual=6.0)
        weights = dict(zip(COEFFICIENTS, judged.weights.tolist()))
        assert all(weights[name] <= 0 for name in AGAINST)
        assert all(weights[name] >= 0 for name in IN_FAVOUR)
        assert shipped.score(seen, category, 0.95) > 0.7
        assert shipped.score(bad, category, 0.5) < 0.6 * shipped.score(seen, category, 0.5)
