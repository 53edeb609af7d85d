"""`nodeslam train acceptance`: fit the score of reconstructed objects on rendered scenes.

Scenes of the training families and kinds of distractors are rendered, detected with the present detector and
reconstructed from single views (``acceptance_fits``). One logistic regression for each class separates the
fits of objects from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from app.training.acceptance_fits import collect
from app.training.class_metrics import calibration_error
from app.training.crop_dataset import Progress
from app.training.files import checksums
from app.training.resources import Resources
from perception.errors import PerceptionError
from perception.inference.acceptance import (
    AGAINST,
    COEFFICIENTS,
    IN_FAVOUR,
    LINEAR,
    WEIGHTS_FILE,
    AcceptanceModel,
    ClassModel,
    numbers_of,
    terms,
)
from perception.inference.evidence import Evidence
from perception.types import CATEGORIES, Category


@dataclass(frozen=True)
class AcceptanceTraining:
    """Hyperparameters of the regression.

    Attributes:
        seed: Seed of the images and of the noise.
        copies: Copies of each sample, each with other noise on the class probability.
        class_noise: Standard deviation of the noise on the log odds of the class probability, in nats. The
            detector is surer on the kinds it was trained on than on others; the noise keeps the regression
            from neglecting the evidence.
        class_dropout: Share of the copies without class probability, as detections of other sources.
        ridge: Weight of the squared difference from the coefficients of all classes, relative to one sample.
        threshold: Score below which objects are rejected.
    """

    seed: int = 0
    copies: int = 4
    class_noise: float = 1.5
    class_dropout: float = 0.25
    ridge: float = 20.0
    threshold: float = 0.2


@dataclass(frozen=True)
class TrainAcceptanceConfig:
    """Configuration of the job; the defaults are those of the shipped coefficients.

    Attributes:
        pictures: Number of images of the training split.
        test: Number of images of the test split, for the evaluation.
        training: Hyperparameters of the regression.
        device: Torch device of the networks.
    """

    pictures: int = 240
    test: int = 60
    training: AcceptanceTraining = AcceptanceTraining()
    device: str = "cpu"


@dataclass(frozen=True)
class Samples:
    """n fits of one class.

    Attributes:
        numbers: (n, k) numbers of the evidence.
        probability: (n,) class probability of the detector.
        real: (n,) whether the mask shows an object of the class.
    """

    numbers: Float[np.ndarray, "n k"]
    probability: Float[np.ndarray, "n"]
    real: Bool[np.ndarray, "n"]


def run(
    config: TrainAcceptanceConfig,
    out_dir: Path,
    progress: Progress | None = None,
    resources: Resources = Resources(),
) -> dict[str, Any]:
    """Reconstruct rendered scenes, fit the regression and evaluate it on the test split.

    Writes `fits/`, `acceptance.json` and `acceptance.md` to the folder; finished chunks are reused.

    Returns:
        Metrics on the test split (``acceptance_metrics``).
    """
    seed, folder = config.training.seed, out_dir / "fits"
    train = collect(folder, "train", config.pictures, seed, resources.workers, progress)
    test = collect(folder, "test", config.test, seed, resources.workers, progress)
    model = fit_model(train, config.training)
    metrics = acceptance_metrics(model, test)
    model.save(out_dir / WEIGHTS_FILE)
    card = _CARD.format(
        config=config, t=config.training, n=len(train), m=metrics, table=acceptance_table(metrics)
    )
    (out_dir / "acceptance.md").write_text(card + checksums(out_dir / WEIGHTS_FILE), "utf-8")
    return metrics


def samples_of(rows: Sequence[dict[str, Any]], category: Category) -> Samples:
    """Return the fits as a class."""
    chosen = [row for row in rows if row["category"] == category]
    return Samples(
        np.array([numbers_of(Evidence(**row["evidence"])) for row in chosen]).reshape(-1, len(LINEAR)),
        np.array([row["probability"] for row in chosen], dtype=np.float64),
        np.array([row["real"] for row in chosen], dtype=bool),
    )


def fit_model(rows: Sequence[dict[str, Any]], training: AcceptanceTraining) -> AcceptanceModel:
    """Fit the logistic model of every class.

    A model of all classes together is fitted first; the penalty draws the weights of each class to it. What
    is rare among the fits of one class is learned from the others.

    Raises:
        PerceptionError: A class has fewer than five fits of either kind.
    """
    rng = np.random.default_rng(training.seed)
    inputs: dict[Category, _Inputs] = {
        category: _inputs(samples_of(rows, category), training, rng) for category in CATEGORIES
    }
    ridge = training.ridge * training.copies
    common = logistic_regression(
        np.concatenate([i.x for i in inputs.values()]), np.concatenate([i.y for i in inputs.values()]), ridge
    )
    models: dict[Category, ClassModel] = {}
    for category, i in inputs.items():
        weights = logistic_regression(i.x, i.y, ridge, common)
        models[category] = ClassModel(i.mean, i.std, weights[1:], float(weights[0]))
    return AcceptanceModel(models, training.threshold)


@dataclass(frozen=True)
class _Inputs:
    """Inputs of the regression of one class: mean and deviation of its objects, terms, and labels."""

    mean: Float[np.ndarray, "n"]
    std: Float[np.ndarray, "n"]
    x: Float[np.ndarray, "m k"]
    y: Bool[np.ndarray, "m"]


def _inputs(samples: Samples, training: AcceptanceTraining, rng: np.random.Generator) -> _Inputs:
    if min(samples.real.sum(), (~samples.real).sum()) < 5:
        raise PerceptionError("too few fits of a class: render more images")
    good = samples.numbers[samples.real]
    mean, std = good.mean(axis=0), np.maximum(good.std(axis=0), 0.05)
    p = np.clip(samples.probability, 1e-6, 1 - 1e-6)
    rows = []
    for _ in range(training.copies):
        odds = np.log(p) - np.log1p(-p) + rng.normal(0, training.class_noise, len(p))
        known = rng.random(len(odds)) >= training.class_dropout
        noisy = 1 / (1 + np.exp(-odds))
        rows += [
            terms(numbers, mean, std, float(value) if is_known else None)
            for numbers, value, is_known in zip(samples.numbers, noisy, known)
        ]
    x = np.column_stack([np.ones(len(rows)), np.array(rows)])
    return _Inputs(mean, std, x, np.tile(samples.real, training.copies))


def logistic_regression(
    x: Float[np.ndarray, "n k"],
    y: Bool[np.ndarray, "n"],
    ridge: float,
    centre: Float[np.ndarray, "k"] | None = None,
) -> Float[np.ndarray, "k"]:
    """Return the weights of a logistic regression with an L2 penalty; signs as ``AGAINST`` and ``IN_FAVOUR``.

    Args:
        x: A constant column, then the ``COEFFICIENTS``; fewer are possible.
        y: Labels.
        ridge: Weight of the squared weights, but for the first, relative to one sample.
        centre: Weights to which the penalty draws; 0 if None.
    """
    sign = np.where(y, 1.0, -1.0)
    penalty = np.r_[0.0, np.full(x.shape[1] - 1, ridge)]
    origin = np.zeros(x.shape[1]) if centre is None else centre

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin = sign * (x @ weights)
        slope = -sign / (1 + np.exp(np.clip(margin, -50, 50)))
        pull = penalty * (weights - origin)
        value = np.logaddexp(0.0, -margin).sum() + 0.5 * pull @ (weights - origin)
        return float(value), x.T @ slope + pull

    bounds = [(None, None)] + [
        (0.0 if name in IN_FAVOUR else None, 0.0 if name in AGAINST else None)
        for name in COEFFICIENTS[: x.shape[1] - 1]
    ]
    found = minimize(loss, origin, jac=True, method="L-BFGS-B", bounds=bounds)
    return np.asarray(found.x)


def acceptance_metrics(model: AcceptanceModel, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the ``share_metrics`` of a model."""
    scores = np.array([
        model.score(Evidence(**row["evidence"]), row["category"], row["probability"]) for row in rows
    ])  # fmt: skip
    return share_metrics(scores, model.threshold, rows)


def share_metrics(
    scores: Float[np.ndarray, "n"], threshold: float, rows: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Return shares of accepted fits and the calibration error, of first choices of the detector.

    The detector alone accepts what has a class probability above one half.

    Args:
        scores: Scores of the fits.
        threshold: Score from which on they are accepted.
        rows: The fits.
    """
    first = np.array([row["rank"] == 0 for row in rows])
    real = np.array([row["real"] for row in rows])
    sure = np.array([row["probability"] > 0.5 for row in rows])
    metrics: dict[str, Any] = {
        "fits": len(rows),
        "calibration_error": calibration_error(scores, real),
        "classes": {},
    }
    for category in CATEGORIES:
        own = first & np.array([row["category"] == category for row in rows])
        kept = scores >= threshold
        metrics["classes"][category] = {
            "objects": int((own & real).sum()),
            "objects_accepted": float(kept[own & real].mean()) if (own & real).any() else None,
            "objects_by_detector": float(sure[own & real].mean()) if (own & real).any() else None,
            "others": int((own & ~real).sum()),
            "others_accepted": float(kept[own & ~real].mean()) if (own & ~real).any() else None,
            "others_by_detector": float(sure[own & ~real].mean()) if (own & ~real).any() else None,
        }
    return metrics


def acceptance_table(metrics: dict[str, Any]) -> str:
    """Return the shares of accepted fits (``share_metrics``) as a Markdown table."""
    head = (
        "| class | objects | accepted | by the detector alone | others | accepted | by the detector alone |"
    )
    lines = [head, "|" + " --- |" * 7]
    for category, m in metrics["classes"].items():
        cells = [m[k] for k in ("objects", "objects_accepted", "objects_by_detector")]
        cells += [m[k] for k in ("others", "others_accepted", "others_by_detector")]
        text = ["-" if c is None else f"{c:.3f}" if isinstance(c, float) else str(c) for c in cells]
        lines.append(f"| {category} | " + " | ".join(text) + " |")
    return "\n".join(lines)


_CARD = """# Acceptance model

`acceptance.json`: one logistic regression for each class that turns the evidence of a fit
(`perception/inference/evidence.py`: agreement of the rendered shape with the measured depth inside and
outside the mask, visible free space, size, cross-sections, contact with the plane) and the detector's class
probability into the probability that the object is real and of that class. Objects below {t.threshold} are
left out.

**Training**: `nodeslam train acceptance --seed {t.seed}`: {config.pictures} scenes of the training families
with the distractors, rooms and sensors of `nodeslam train detector`; each instance that the detector segments
is reconstructed from its single view as its two most probable classes: {n} fits. Noise with a standard
deviation of {t.class_noise:g} is added to the log odds of the class probability, since the detector is surer
on the kinds it was trained on than on others.

**Evaluation** on {m[fits]} fits in {config.test} scenes of the test families and test kinds of distractors:
expected calibration error {m[calibration_error]:.3f}. Accepted, of the fits as the detector's first choice:

{table}

**Limitations**: rendered images. What has the outline, the size and the contact of a bottle or can is told
from one by the detector alone.
"""
