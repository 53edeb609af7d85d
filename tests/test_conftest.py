"""The check of array shapes in signatures, which every test runs with."""

import numpy as np
import pytest

from perception.geometry import transform_points
from perception.types import SupportPlane

EVERY = 50  # of so many consecutive calls at least one is checked


def refused(call):
    """How many of consecutive calls the check of types refuses."""
    count = 0
    for _ in range(EVERY):
        try:
            call()
        except Exception as error:
            assert "type" in type(error).__name__.lower(), error
            count += 1
    return count


def test_a_wrong_shape_is_refused():
    points = np.zeros((5, 3))
    assert refused(lambda: transform_points(np.eye(5), points)) >= 1
    assert refused(lambda: transform_points(np.eye(4), points)) == 0


def test_a_field_of_a_wrong_shape_is_refused():
    assert refused(lambda: SupportPlane(np.array([0.0, 0.0, 0.6, 0.8]), 0.0)) >= 1


def test_an_integer_will_do_for_a_float():
    assert refused(lambda: SupportPlane(np.array([0.0, 0.0, 1.0]), 1)) == 0


def test_functions_keep_their_names_and_signatures():
    assert transform_points.__name__ == "transform_points"
    with pytest.raises(TypeError, match="points"):
        transform_points(np.eye(4))
