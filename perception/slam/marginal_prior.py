"""Priors on landmarks from keyframes outside the optimised window.

Each keyframe contributes the normal equations of its depth residuals with its own camera pose marginalised
out: a quadratic in the landmark's parameters. It is anchored at the landmark's state when that keyframe was
last optimised, not at the present state: the latter would only damp the landmark's motion and let it drift
from window to window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.inference.problem import PARAMETERS, FitState


@dataclass(frozen=True)
class ViewInformation:
    """Information of one keyframe on one landmark.

    Attributes:
        state: State of the landmark at which the residuals were linearised.
        information: Information matrix on its 25 parameters, without priors.
    """

    state: FitState
    information: Float[np.ndarray, "25 25"]


@dataclass(frozen=True)
class MarginalPrior:
    """Quadratic cost of a step of a landmark away from its present state.

    cost(step) = step^T information step + 2 gradient^T step + constant.

    Attributes:
        information: Information matrix on the landmark's 25 parameters.
        gradient: Half of the cost's gradient at step 0.
        constant: Cost at step 0.
    """

    information: Float[np.ndarray, "25 25"]
    gradient: Float[np.ndarray, "25"]
    constant: float = 0.0

    @staticmethod
    def of(views: Sequence[ViewInformation], state: FitState, max_views: float) -> MarginalPrior:
        """Return the sum of the views' quadratics.

        Args:
            views: Information of the keyframes outside the window.
            state: Present state of the landmark, from which steps are counted.
            max_views: Total weight of more views than this many is limited to this number.
        """
        weight = min(1.0, max_views / max(len(views), 1))
        information = np.zeros((PARAMETERS, PARAMETERS))
        gradient, constant = np.zeros(PARAMETERS), 0.0
        for view in views:
            step, of_view = state.step_from(view.state), weight * view.information
            gradient_of_view = of_view @ step
            information = information + of_view
            gradient = gradient + gradient_of_view
            constant = constant + float(step @ gradient_of_view)
        return MarginalPrior(information, gradient, constant)

    def cost_at(self, step: Float[np.ndarray, "25"]) -> float:
        """Return the cost of a step."""
        return float(step @ self.information @ step + 2 * self.gradient @ step + self.constant)

    def gradient_at(self, step: Float[np.ndarray, "25"]) -> Float[np.ndarray, "25"]:
        """Return half of the cost's gradient after a step, as it enters the normal equations."""
        return self.information @ step + self.gradient
