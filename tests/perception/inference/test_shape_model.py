"""Linearised shapes: log odds are linear in the code."""

import numpy as np

from perception.inference.shape_model import LinearisedShape, linearise, mean_shape
from perception.rendering.sampling import SIDE


def occupancies(shape) -> np.ndarray:
    """The grid without its border."""
    side = int(SIDE)
    return shape.occupancy.numpy().reshape(side, side, side)[1:-1, 1:-1, 1:-1]


def test_the_grid_at_the_linearisations_code_is_the_decoded_one(decoder) -> None:
    code = np.full(16, 0.2)
    shape = linearise(decoder, "can", code)
    np.testing.assert_array_equal(shape.code, code)
    np.testing.assert_array_equal(occupancies(shape.at(code)), shape.grid)
    np.testing.assert_allclose(shape.grid, decoder("can", code), atol=1e-6)


def test_log_odds_are_linear_in_the_code() -> None:
    grid = np.full((32, 32, 32), 0.3, np.float32)
    jacobian = np.zeros((32, 32, 32, 16), np.float32)
    jacobian[..., 2], jacobian[..., 5] = 0.1, -0.2
    shape = LinearisedShape(grid, jacobian, np.zeros(16))
    step = np.zeros(16)
    step[2], step[5] = 0.4, 0.1
    logit = np.log(0.3 / 0.7) + (0.1 * 0.4 - 0.2 * 0.1) / (0.3 * 0.7)
    np.testing.assert_allclose(occupancies(shape.at(step)), 1 / (1 + np.exp(-logit)), rtol=1e-5)
    np.testing.assert_allclose(occupancies(shape.at(np.zeros(16))), 0.3, rtol=1e-6)  # at() changes nothing


def test_mean_shapes_are_decoded_once(decoder) -> None:
    assert mean_shape(decoder, "can") is mean_shape(decoder, "can")
    assert mean_shape(decoder, "can") is not mean_shape(decoder, "mug")
    np.testing.assert_array_equal(mean_shape(decoder, "can").code, 0)
