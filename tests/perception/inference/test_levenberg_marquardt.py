"""Levenberg-Marquardt on problems with known minima."""

import numpy as np
import pytest

from perception.inference.levenberg_marquardt import Evaluation, LmConfig, minimise


def _rosenbrock(x: np.ndarray) -> Evaluation:
    residuals = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    return Evaluation(residuals, np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]), np.ones(2))


def _powell(x: np.ndarray) -> Evaluation:
    """Powell's singular function: the Jacobian loses rank at the minimum, 0."""
    a, b, c, d = x
    residuals = np.array([a + 10 * b, np.sqrt(5) * (c - d), (b - 2 * c) ** 2, np.sqrt(10) * (a - d) ** 2])
    jacobian = np.array(
        [
            [1, 10, 0, 0],
            [0, 0, np.sqrt(5), -np.sqrt(5)],
            [0, 2 * (b - 2 * c), -4 * (b - 2 * c), 0],
            [2 * np.sqrt(10) * (a - d), 0, 0, -2 * np.sqrt(10) * (a - d)],
        ]
    )
    return Evaluation(residuals, jacobian, np.ones(4))


PROBLEMS = {
    "rosenbrock": (_rosenbrock, np.array([-1.2, 1.0]), np.array([1.0, 1.0]), 1e-6),
    "powell": (_powell, np.array([3.0, -1.0, 0.0, 1.0]), np.zeros(4), 2e-2),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_finds_the_known_minimum(name: str) -> None:
    evaluate, start, minimum, tolerance = PROBLEMS[name]
    result = minimise(evaluate, np.add, start, LmConfig(max_iterations=200, tolerance=0.0))
    np.testing.assert_allclose(result.state, minimum, atol=tolerance)
    assert result.trace[0].cost == pytest.approx(evaluate(start).cost)


def test_weighted_linear_problem_in_few_steps() -> None:
    rng = np.random.default_rng(0)
    A, b, w = rng.normal(size=(30, 4)), rng.normal(size=30), rng.uniform(0.1, 2, 30)
    expected = np.linalg.solve(A.T @ (w[:, None] * A), A.T @ (w * b))
    result = minimise(lambda x: Evaluation(A @ x - b, A, w), np.add, np.zeros(4))
    assert result.status == "converged"
    np.testing.assert_allclose(result.state, expected, atol=1e-6)


def test_weights_are_frozen_while_costs_are_compared() -> None:
    # With weights that fade with x, the weighted cost falls for ever; with frozen ones only x = 0 is better.
    def fading(x: np.ndarray) -> Evaluation:
        return Evaluation(x + 0.0, np.eye(1), 1 / (1 + np.abs(x)) ** 4)

    result = minimise(fading, np.add, np.array([1.0]))
    np.testing.assert_allclose(result.state, 0.0, atol=1e-4)


def test_steps_away_from_the_minimum_are_rejected_though_weights_fade() -> None:
    def fading(x: np.ndarray) -> Evaluation:  # a wrong Jacobian leads uphill, where weights are small
        return Evaluation(x + 0.0, -np.eye(1), 1 / (1 + np.abs(x)) ** 4)

    result = minimise(fading, np.add, np.array([1.0]), LmConfig(max_iterations=100))
    assert result.status == "stuck" and not any(line.accepted for line in result.trace)
    np.testing.assert_array_equal(result.state, 1.0)


def test_costs_of_accepted_steps_fall() -> None:
    trace = minimise(_rosenbrock, np.add, np.array([-1.2, 1.0])).trace
    assert any(line.accepted for line in trace)
    assert all(line.cost_after < line.cost for line in trace if line.accepted)


def test_steps_too_small_to_matter_are_not_taken() -> None:
    target, seen = np.array([3.0, -1.0]), []

    def evaluate(x: np.ndarray) -> Evaluation:
        seen.append(x)
        return Evaluation(x - target, np.eye(2), np.ones(2))

    config = LmConfig(damping=1e-6, least_step=1e-3)
    result = minimise(evaluate, lambda x, step: x + step, np.zeros(2), config)
    assert result.status == "converged" and len(seen) == 2
    np.testing.assert_allclose(result.state, target, atol=1e-3)


def test_step_limit_shortens_the_step() -> None:
    config, limit = LmConfig(max_iterations=1), np.array([0.5])
    result = minimise(
        lambda x: Evaluation(x - 100, np.eye(1), np.ones(1)), np.add, np.zeros(1), config, limit
    )
    assert result.state[0] == pytest.approx(0.5)
    assert result.status == "max_iterations"


def test_blind_directions_do_not_move() -> None:
    result = minimise(
        lambda x: Evaluation(x[:1] - 1, np.array([[1.0, 0.0]]), np.ones(1)), np.add, np.array([0.0, 7.0])
    )
    np.testing.assert_allclose(result.state, [1.0, 7.0], atol=1e-6)


def test_nan_is_a_status() -> None:
    result = minimise(lambda x: Evaluation(x * np.nan, np.eye(2), np.ones(2)), np.add, np.zeros(2))
    assert result.status == "not_finite"
    np.testing.assert_array_equal(result.state, np.zeros(2))


def test_wrong_jacobian_ends_stuck() -> None:
    result = minimise(
        lambda x: Evaluation(x, -np.eye(2), np.ones(2)), np.add, np.ones(2), LmConfig(max_iterations=100)
    )
    assert result.status == "stuck"
    np.testing.assert_array_equal(result.state, np.ones(2))


def scripted(*costs: float):
    """Return an evaluation whose calls have the given costs, whatever the state."""
    left = iter(costs)
    return lambda _: Evaluation(np.sqrt([next(left)]), np.ones((1, 1)), np.ones(1))


def test_two_consecutive_small_gains_are_convergence() -> None:
    small = 1 - 5e-6  # decrease below the tolerance of 1e-5
    result = minimise(scripted(1.0, small, 0.5, 0.5 * small, 0.5 * small**2, 0.1), np.add, np.zeros(1))
    assert result.status == "converged" and len(result.trace) == 4
    result = minimise(scripted(1.0, small, small**2, 0.1), np.add, np.zeros(1))
    assert result.status == "converged" and len(result.trace) == 2


def test_damping_grows_with_rejected_and_falls_with_accepted_steps() -> None:
    config = LmConfig(max_iterations=5, damping=0.1, up=7.0, down=0.2, min_damping=0.05)
    result = minimise(scripted(4.0, 5.0, 3.0, 2.0, 1.0, 0.5), np.add, np.zeros(1), config)
    assert [line.accepted for line in result.trace] == [False, True, True, True, True]
    assert [line.damping for line in result.trace] == pytest.approx([0.1, 0.7, 0.14, 0.05, 0.05])
    assert [line.cost for line in result.trace] == pytest.approx([4.0, 4.0, 3.0, 2.0, 1.0])


def test_damping_scales_the_diagonal() -> None:
    """One step of a diagonal problem: step = -J r / (J^2 (1 + damping)) in each parameter."""
    jacobian, residuals = np.diag([1.0, 10.0]), np.array([2.0, 30.0])
    config = LmConfig(max_iterations=1, damping=0.25)
    result = minimise(
        lambda x: Evaluation(residuals + jacobian @ x, jacobian, np.ones(2)), np.add, np.zeros(2), config
    )
    np.testing.assert_allclose(result.state, [-2.0 / 1.25, -3.0 / 1.25], rtol=1e-6)
