"""What keyframes outside a window remember of a landmark.

A window of a few keyframes would forget what was seen of an object before. So what each keyframe said of it,
its normal equations with the camera's own doubt taken out, stays as a quadratic about the state that the
landmark had when that keyframe was last optimised. About the landmark's present state it would only slow the
landmark down: from window to window it would creep away from where it was seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.inference.problem import PARAMETERS, FitState


@dataclass(frozen=True)
class View:
    """What a keyframe said of a landmark: where it was then, and how surely (without priors)."""

    state: FitState
    information: Float[np.ndarray, "25 25"]


@dataclass(frozen=True)
class Memory:
    """What views outside a window say of a landmark, as a function of its step from where it stands now.

    A step costs ``step @ information @ step + 2 * pull @ step + cost``.
    """

    information: Float[np.ndarray, "25 25"]
    pull: Float[np.ndarray, "25"]
    cost: float = 0.0

    @staticmethod
    def of(views: Sequence[View], state: FitState, most: float) -> Memory:
        """Of a landmark at a state; more than ``most`` views count as so many."""
        share = min(1.0, most / max(len(views), 1))
        memory = Memory(np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS))
        for view in views:
            step, information = state.step_from(view.state), share * view.information
            pull = information @ step
            memory = Memory(
                memory.information + information, memory.pull + pull, memory.cost + float(step @ pull)
            )
        return memory

    def cost_of(self, step: Float[np.ndarray, "25"]) -> float:
        return float(step @ self.information @ step + 2 * self.pull @ step + self.cost)

    def gradient(self, step: Float[np.ndarray, "25"]) -> Float[np.ndarray, "25"]:
        """Half of the cost's derivative, as in the normal equations."""
        return self.information @ step + self.pull
