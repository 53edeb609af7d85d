"""Verifier of single views: a small network that scores upright fits to one image.

One image leaves more open than several, and the logistic models of ``acceptance`` weigh each number of the
evidence alone. The verifier combines them: its inputs are the same numbers relative to true objects of the
class, the log odds of the logistic model, and the probabilities that the detector gives to all classes. The
logit is the mean over a few perceptrons with one hidden layer:  l = mean_m v_m . max(0, W_m x + b_m) + c_m.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from perception.errors import PerceptionError
from perception.io.weights import WEIGHTS_DIRECTORY, check_shapes, read_weights, write_weights
from perception.types import CATEGORIES, OTHER, Category

WEIGHTS_FILE = "verifier.safetensors"
LOGIT_SCALE = 3.0  # by which log odds are divided
N_CONTEXT = OTHER + 1 + 1 + len(CATEGORIES) + 1  # inputs beside the numbers of the evidence

_LEAST = 1e-3  # smallest class probability, and its largest distance from 1
_REMEDY = "reinstall the package, or retrain with `nodeslam train verifier`"


def verifier_inputs(
    z: Float[np.ndarray, "n"], log_odds: float, category: Category, probabilities: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "k"]:
    """Return the inputs of the network for one fit.

    Args:
        z: Numbers of the evidence relative to true objects of the class, in standard deviations, clipped.
        log_odds: Log odds of the logistic model without class probability.
        category: Class of the fit.
        probabilities: Class probabilities of the detector, of no class as the last.
    """
    p = np.clip(probabilities, _LEAST, 1 - _LEAST)
    logits = np.log(p) - np.log1p(-p)
    number = CATEGORIES.index(category)
    context = [*logits / LOGIT_SCALE, logits[number] / LOGIT_SCALE, *np.eye(len(CATEGORIES))[number]]
    return np.array([*z, *context, log_odds / LOGIT_SCALE])


@dataclass(frozen=True)
class Verifier:
    """An ensemble of m perceptrons with k inputs and h hidden units.

    Attributes:
        hidden_weight, hidden_bias: Of the hidden layers.
        output_weight, output_bias: Of the outputs.
        threshold: Score below which an object is rejected.
    """

    hidden_weight: Float[np.ndarray, "m h k"]
    hidden_bias: Float[np.ndarray, "m h"]
    output_weight: Float[np.ndarray, "m h"]
    output_bias: Float[np.ndarray, "m"]
    threshold: float

    @staticmethod
    def load(n_numbers: int, path: Path | None = None) -> Verifier:
        """Return the shipped network, or that of a file.

        Args:
            n_numbers: Number of numbers of the evidence.
            path: Weights file; the shipped one if None.

        Raises:
            PerceptionError: The file is missing, damaged, differs from its checksum, or is of another
                network.
        """
        path = path or WEIGHTS_DIRECTORY / WEIGHTS_FILE
        tensors, about = read_weights(path, _REMEDY)
        hidden = tensors.get("hidden_weight", np.zeros((0, 0, 0)))
        m, h = hidden.shape[:2] if hidden.ndim == 3 else (0, 0)
        k = n_numbers + N_CONTEXT
        shapes = {
            "hidden_weight": (m, h, k),
            "hidden_bias": (m, h),
            "output_weight": (m, h),
            "output_bias": (m,),
        }
        check_shapes(tensors, shapes, path, _REMEDY)
        try:
            threshold = float(about["threshold"])
            if m == 0 or not 0 <= threshold <= 1:
                raise ValueError
        except (KeyError, ValueError):
            raise PerceptionError(
                f"weights {path} hold no verifier: no members or threshold; {_REMEDY}"
            ) from None
        return Verifier(**{name: tensors[name].astype(np.float64) for name in shapes}, threshold=threshold)

    def save(self, path: Path) -> None:
        """Write the weights in single precision."""
        names = ("hidden_weight", "hidden_bias", "output_weight", "output_bias")
        tensors = {name: getattr(self, name).astype(np.float32) for name in names}
        write_weights(path, tensors, {"task": "verifier", "threshold": f"{self.threshold:g}"})

    def score(self, inputs: Float[np.ndarray, "k"]) -> float:
        """Return the probability that an object is real and of the class of its fit."""
        hidden = np.maximum(self.hidden_weight @ inputs + self.hidden_bias, 0.0)
        logit = float(((self.output_weight * hidden).sum(axis=1) + self.output_bias).mean())
        return float(1 / (1 + np.exp(-np.clip(logit, -50, 50))))
