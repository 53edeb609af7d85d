"""Levenberg-Marquardt for weighted least squares on a manifold; failures are reported as a status.

At a state x with residuals r, Jacobian J and weights w it solves the damped normal equations

    (J^T W J + lambda diag(J^T W J)) step = -J^T W r

and accepts the step if sum w r^2 decreases with the weights of the linearisation: weights may depend on the
state (robust, or by a predicted variance), and reweighting within the comparison would favour states of large
variance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import numpy as np
from jaxtyping import Float

State = TypeVar("State")
LmStatus = Literal["converged", "max_iterations", "stuck", "not_finite"]

_FLOOR = 1e-9  # damping relative to the largest diagonal entry: the step is 0 along unobservable directions


@dataclass(frozen=True)
class Evaluation:
    """Weighted least-squares problem at one state, of cost sum_i w_i r_i^2.

    Attributes:
        residuals: Residuals r.
        jacobian: Derivative of the residuals with respect to a step in the tangent space.
        weights: Weights w, not negative.
    """

    residuals: Float[np.ndarray, "n"]
    jacobian: Float[np.ndarray, "n p"]
    weights: Float[np.ndarray, "n"]

    @property
    def cost(self) -> float:
        return float(self.weights @ self.residuals.astype(np.float64) ** 2)

    def normal_equations(self) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p"]]:
        """Return J^T W J and J^T W r, in float64."""
        root = np.sqrt(self.weights).astype(self.jacobian.dtype)
        rows, residuals = self.jacobian * root[:, None], self.residuals.astype(self.jacobian.dtype) * root
        return (rows.T @ rows).astype(np.float64), (rows.T @ residuals).astype(np.float64)


@dataclass(frozen=True)
class LmConfig:
    """Damping schedule and termination.

    Attributes:
        max_iterations: Largest number of iterations.
        damping: Initial damping lambda.
        down: Factor of the damping after an accepted step.
        up: Factor of the damping after a rejected step.
        min_damping: Smallest damping.
        max_damping: Damping above which the minimisation is stuck.
        tolerance: Relative decrease of the cost that is small; converged after two consecutive accepted steps
            with at most this decrease.
        least_step: Norm of a step below which the minimisation has converged; that step is not taken.
    """

    max_iterations: int = 30
    damping: float = 1e-2
    down: float = 0.3
    up: float = 5.0
    min_damping: float = 1e-7
    max_damping: float = 1e6
    tolerance: float = 1e-5
    least_step: float = 0.0


@dataclass(frozen=True)
class LmIteration:
    """One iteration.

    Attributes:
        cost: Cost before the step.
        cost_after: Cost after the step, with the weights of the linearisation.
        damping: Damping of the step.
        accepted: Whether the step was accepted.
    """

    cost: float
    cost_after: float
    damping: float
    accepted: bool


@dataclass(frozen=True)
class LmResult(Generic[State]):
    """Result of a minimisation.

    Attributes:
        state: Final state.
        evaluation: Evaluation of the final state.
        status: Reason for termination.
        damping: Damping with which to continue.
        trace: All iterations.
    """

    state: State
    evaluation: Evaluation
    status: LmStatus
    damping: float
    trace: tuple[LmIteration, ...]


def minimise(
    evaluate: Callable[[State], Evaluation],
    retract: Callable[[State, np.ndarray], State],
    state: State,
    config: LmConfig = LmConfig(),
    step_limit: Float[np.ndarray, "p"] | None = None,
) -> LmResult[State]:
    """Minimise the weighted squared residuals.

    Args:
        evaluate: Returns residuals, Jacobian and weights at a state.
        retract: Returns the state after a step in its tangent space.
        state: Initial state.
        config: Damping and termination.
        step_limit: Largest step of each parameter; longer steps are scaled down as a whole.
    """
    damping, small_gains, trace = config.damping, 0, []
    current = evaluate(state)
    hessian, gradient = current.normal_equations()
    status: LmStatus = "max_iterations"
    for _ in range(config.max_iterations):
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
            status = "not_finite"
            break
        step = _damped_step(hessian, gradient, damping, step_limit)
        if np.linalg.norm(step) < config.least_step:
            status = "converged"
            break
        candidate = retract(state, step)
        proposed = evaluate(candidate)
        cost = current.cost
        cost_after = float(current.weights @ proposed.residuals.astype(np.float64) ** 2)
        accepted = bool(cost_after < cost)
        trace.append(LmIteration(cost, cost_after, damping, accepted))
        if not accepted:
            damping *= config.up
            if damping > config.max_damping:
                status = "stuck"
                break
            continue
        damping = max(damping * config.down, config.min_damping)
        state, current = candidate, proposed
        hessian, gradient = current.normal_equations()
        small_gains = small_gains + 1 if cost - cost_after <= config.tolerance * cost else 0
        if small_gains == 2 or cost_after == 0.0:
            status = "converged"
            break
    return LmResult(state, current, status, damping, tuple(trace))


def _damped_step(
    hessian: np.ndarray, gradient: np.ndarray, damping: float, step_limit: np.ndarray | None
) -> np.ndarray:
    diagonal = np.diag(hessian)
    scale = diagonal * damping + _FLOOR * max(float(diagonal.max()), 1e-12)
    step = -np.linalg.solve(hessian + np.diag(scale), gradient)
    if step_limit is not None:
        step = step / max(1.0, float(np.max(np.abs(step) / step_limit)))
    return step
