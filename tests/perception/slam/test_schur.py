"""The Schur complement against the solution of the complete system."""

import numpy as np
import pytest

from perception.slam.schur import NormalEquations, solve_by_schur


@pytest.mark.parametrize(("objects", "cameras"), [(3, 2), (1, 1), (4, 0), (0, 1)])
def test_schur_solves_the_complete_damped_system(objects, cameras):
    rng = np.random.default_rng(objects)
    c, n = 6 * cameras, 25
    size = c + n * objects
    H, g = np.zeros((size, size)), rng.normal(size=size)
    for k in range(max(objects, 1)):  # rows couple the cameras with one object each
        J = np.zeros((80, size))
        J[:, :c] = rng.normal(size=(80, c))
        if objects:
            J[:, c + n * k : c + n * (k + 1)] = rng.normal(size=(80, n))
        H += J.T @ J
    at = [slice(c + n * k, c + n * (k + 1)) for k in range(objects)]
    equations = NormalEquations(
        cameras=H[:c, :c],
        objects=np.array([H[s, s] for s in at]).reshape(-1, n, n),
        coupling=np.array([H[s, :c] for s in at]).reshape(objects, n, c),
        gradient_cameras=g[:c],
        gradient_objects=np.array([g[s] for s in at]).reshape(-1, n),
    )
    expected = -np.linalg.solve(H + 0.05 * np.diag(np.diag(H)), g)
    camera_step, object_steps = solve_by_schur(equations, 0.05)
    steps = np.concatenate([camera_step, object_steps.ravel()])
    np.testing.assert_allclose(steps, expected, rtol=1e-6, atol=1e-9)


def test_unobserved_directions_do_not_move():
    H = np.eye(25)
    H[3] = 0
    g = np.ones(25)
    g[3] = 0
    equations = NormalEquations(np.zeros((0, 0)), H[None], np.zeros((1, 25, 0)), np.zeros(0), g[None])
    _, (step,) = solve_by_schur(equations, 0.0)
    np.testing.assert_allclose(step, -g, rtol=1e-6)
