"""Calibrated score of a fit: the probability that the object is real and of the fitted class.

One logistic model for each class on the numbers of ``evidence`` and the class probability of the detector.
Numbers are compared with those of true objects of the class: z is their standardised and clipped difference,
and the log odds are b + sum of w z over all numbers + sum of q z^2 over those with a typical value, such as
sizes. ``nodeslam train acceptance`` fits the coefficients. Upright fits to a single view are scored by the
``verifier`` instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from perception.errors import PerceptionError
from perception.inference.evidence import Evidence
from perception.inference.verifier import Verifier, verifier_inputs
from perception.io.files import read_json, write_json
from perception.io.weights import WEIGHTS_DIRECTORY, verify_weights
from perception.types import CATEGORIES, OTHER, Category

WEIGHTS_FILE = "acceptance.json"
LINEAR = (
    "uncovered", "in_front", "behind", "free_space", "residual", "systematic", "base", "sunk",
    "truncated", "pixels", "code", "section", "aspect", "height", "radius", "slenderness", "neck", "box",
    "converged",
)  # fmt: skip
QUADRATIC = ("height", "radius", "slenderness", "neck", "box", "aspect")
CLASS_TERMS = ("class_logit", "class_known")
COEFFICIENTS = (*LINEAR, *(f"{name}^2" for name in QUADRATIC), *CLASS_TERMS)

# Terms whose weight can only lower, or only raise, the score: what contradicts a shape never supports it.
AGAINST = (
    "uncovered", "in_front", "behind", "free_space", "residual", "systematic", "base", "sunk", "truncated",
    "code", *(f"{name}^2" for name in QUADRATIC),
)  # fmt: skip
IN_FAVOUR = ("converged", "pixels", "class_logit")

_CLIP = 4.0  # largest difference from true objects that counts, in standard deviations
_LEAST = 0.01  # smallest class probability, and its largest distance from 1: no class is ruled out
_TERMS = {
    "uncovered": "part of its mask is not covered by the shape",
    "in_front": "surfaces are measured in front of the shape",
    "behind": "surfaces are measured behind the shape",
    "free_space": "the background is visible through the shape",
    "residual": "the depth differs from the shape",
    "systematic": "the measured surface is of another shape",
    "sunk": "it reaches below the support plane",
    "base": "it does not reach down to the support plane",
    "truncated": "the image border truncates it",
    "pixels": "it is small in the image",
    "code": "its shape is unusual",
    "section": "its cross-section is unusual",
    "aspect": "its proportions are unusual",
    "height": "its height is unusual",
    "radius": "its radius is unusual",
    "slenderness": "its proportions are unusual",
    "neck": "its upper part is unusual",
    "box": "its cross-section is unusual",
    "converged": "the fit did not converge",
    "class_logit": "the class is uncertain",
}


@dataclass(frozen=True)
class ClassModel:
    """Logistic model of one class.

    Attributes:
        mean, std: Of the numbers in ``LINEAR``, over true objects of the class.
        weights: Weights of ``COEFFICIENTS``.
        bias: Log odds of a typical object without class probability.
    """

    mean: Float[np.ndarray, "n"]
    std: Float[np.ndarray, "n"]
    weights: Float[np.ndarray, "k"]
    bias: float

    def log_odds(self, evidence: Evidence, class_probability: float | None) -> float:
        """Return the log odds that the object is real and of this class."""
        return self.bias + float(self.contributions(evidence, class_probability).sum())

    def contributions(self, evidence: Evidence, class_probability: float | None) -> Float[np.ndarray, "k"]:
        """Return the contribution of each of ``COEFFICIENTS`` to the log odds."""
        return self.weights * terms(numbers_of(evidence), self.mean, self.std, class_probability)


@dataclass(frozen=True)
class AcceptanceModel:
    """Scores fits and explains low scores. Create it with ``load``.

    Attributes:
        classes: Logistic model of each class.
        threshold: Score below which an object is rejected.
        verifier: Scores upright fits to single views; None for the logistic models.
    """

    classes: Mapping[Category, ClassModel]
    threshold: float = 0.5
    verifier: Verifier | None = None

    @staticmethod
    def load(path: Path | None = None) -> AcceptanceModel:
        """Return the model with the shipped coefficients, or those of a file.

        Raises:
            PerceptionError: The file is missing, damaged or differs from its checksum.
        """
        path = path or WEIGHTS_DIRECTORY / WEIGHTS_FILE
        verify_weights(path, "restore it from the repository")
        content = read_json(path, "restore it from the repository, or run `nodeslam train acceptance`")
        try:
            return AcceptanceModel({c: _class_model(content[c]) for c in CATEGORIES}, content["threshold"])
        except (KeyError, TypeError, ValueError) as error:
            raise PerceptionError(f"{path} holds no acceptance model ({error})") from None

    def save(self, path: Path) -> None:
        """Write the coefficients as JSON."""
        write_json(
            path, {c: _as_json(model) for c, model in self.classes.items()} | {"threshold": self.threshold}
        )

    def score(self, evidence: Evidence, category: Category, class_probability: float | None = None) -> float:
        """Return the probability that an object is real and of a class.

        Args:
            evidence: Evidence of its fit as that class.
            category: The class.
            class_probability: Probability of the class by the detector; None if unknown.
        """
        return float(1 / (1 + np.exp(-self.classes[category].log_odds(evidence, class_probability))))

    def verifier_inputs(
        self, evidence: Evidence, category: Category, class_probabilities: Float[np.ndarray, "k"]
    ) -> Float[np.ndarray, "n"]:
        """Return the verifier's inputs for an upright fit to one view.

        Args:
            evidence: Evidence of its fit as a class.
            category: The class.
            class_probabilities: Probabilities of the detector, of no class as the last.
        """
        model = self.classes[category]
        z = standardised(numbers_of(evidence), model.mean, model.std)
        return verifier_inputs(z, model.log_odds(evidence, None), category, class_probabilities)

    def least_score(self, n_views: int) -> float:
        """Return the score below which an object of known class probabilities is rejected."""
        return self.threshold if self.verifier is None or n_views > 1 else self.verifier.threshold

    def existence(
        self, score: float, category: Category, class_probabilities: Float[np.ndarray, "k"]
    ) -> float:
        """Return the probability that an object is real, of whichever class.

        Of an object that may be a bottle or a can, neither has a high score, although it is none of no class.

        Args:
            score: Probability that it is real and of a class, made with the class's probability.
            category: That class.
            class_probabilities: Probabilities of the detector, of no class as the last.
        """
        weight = float(self.classes[category].weights[COEFFICIENTS.index("class_logit")])
        own, any_class = class_probabilities[CATEGORIES.index(category)], 1 - class_probabilities[OTHER]
        log_odds = _logit(score, 1e-9) + weight * (_logit(float(any_class)) - _logit(float(own)))
        return float(1 / (1 + np.exp(-log_odds)))

    def reason(
        self, evidence: Evidence, category: Category, class_probability: float | None = None, count: int = 2
    ) -> str:
        """Return the strongest evidence against an object in words."""
        parts = self.classes[category].contributions(evidence, class_probability)
        total: dict[str, float] = {}
        for name, value in zip(COEFFICIENTS, parts.tolist()):
            text = _TERMS.get(name.removesuffix("^2"))
            if text is not None:
                total[text] = total.get(text, 0.0) + value
        worst = sorted(total, key=total.__getitem__)[:count]
        return ", ".join(text for text in worst if total[text] < -0.3) or "the evidence is weak"


def numbers_of(evidence: Evidence) -> Float[np.ndarray, "n"]:
    """Return the numbers in the order of ``LINEAR``: shares and lengths on logarithmic scales."""
    e = evidence
    share = {n: np.log(getattr(e, n) + 0.02) for n in ("uncovered", "in_front", "behind", "free_space")}
    size = {
        "height": np.log(max(e.height, 1e-3)),
        "radius": np.log(max(e.radius, 1e-3)),
        "slenderness": np.log(max(e.height, 1e-3) / max(2 * e.radius, 1e-3)),
    }
    other = {
        "residual": np.log(max(e.residual, 0.3)),
        "systematic": np.log(max(e.systematic, 0.3)),
        "base": np.log(np.clip(e.base, 0.0, 1.0) + 0.05),
        "sunk": np.log(np.clip(-e.base, 0.0, 1.0) + 0.05),
        "truncated": e.truncated,
        "pixels": np.log(max(e.pixels, 1.0)),
        "code": e.code,
        "section": np.log(e.section + 0.01),
        "aspect": e.aspect,
        "neck": e.neck,
        "box": e.box,
        "converged": e.converged,
    }
    values = share | size | other
    return np.array([values[name] for name in LINEAR])


def standardised(
    numbers: Float[np.ndarray, "n"], mean: Float[np.ndarray, "n"], std: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return the differences from true objects in standard deviations, clipped."""
    return np.clip((numbers - mean) / std, -_CLIP, _CLIP)


def terms(
    numbers: Float[np.ndarray, "n"],
    mean: Float[np.ndarray, "n"],
    std: Float[np.ndarray, "n"],
    class_probability: float | None,
) -> Float[np.ndarray, "k"]:
    """Return the values that ``COEFFICIENTS`` multiply."""
    z = standardised(numbers, mean, std)
    squares = z[[LINEAR.index(name) for name in QUADRATIC]] ** 2
    if class_probability is None:
        return np.concatenate([z, squares, [0.0, 0.0]])
    return np.concatenate([z, squares, [_logit(class_probability), 1.0]])


def _logit(probability: float, least: float = _LEAST) -> float:
    p = min(max(probability, least), 1 - least)
    return float(np.log(p / (1 - p)))


@cache
def shipped_acceptance() -> AcceptanceModel:
    """Load the shipped model with the verifier once."""
    return replace(AcceptanceModel.load(), verifier=Verifier.load(len(LINEAR)))


def _class_model(content: Any) -> ClassModel:
    mean, std = (np.array([float(content[kind][name]) for name in LINEAR]) for kind in ("mean", "std"))
    weights = np.array([float(content["weights"][name]) for name in COEFFICIENTS])
    return ClassModel(mean, std, weights, float(content["bias"]))


def _as_json(model: ClassModel) -> dict[str, Any]:
    def named(names: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
        return {name: round(float(value), 5) for name, value in zip(names, values)}

    return {
        "bias": round(model.bias, 5),
        "mean": named(LINEAR, model.mean),
        "std": named(LINEAR, model.std),
        "weights": named(COEFFICIENTS, model.weights),
    }
