"""Name and bounds of a thing of no class."""

import numpy as np

from perception.obstacles.obstacle import PerceivedObstacle


def test_the_bounds_hold_all_pieces():
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    thing = PerceivedObstacle(3, (corners, corners + np.array((2, 0, 0))), 10)
    assert thing.name == "thing_3"
    np.testing.assert_allclose(thing.bounds, [(0, 0, 0), (3, 1, 1)])


def test_what_is_near_a_piece_is_a_measurement_of_it():
    corners = np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)])
    thing = PerceivedObstacle(0, (corners, corners + np.array((0.5, 0, 0))), 100)
    points = np.array(
        [[0.05, 0.05, 0.05], [0.05, 0.05, 0.11], [0.05, 0.05, 0.13], [0.55, -0.01, 0.05], [0.3, 0.05, 0.05]]
    )
    assert thing.explains(points, 0.02).tolist() == [True, True, False, True, False]
    assert thing.explains(points, 0.0).tolist() == [True, False, False, False, False]


def test_a_flat_piece_explains_what_is_near_it():
    square = np.array([[0.0, 0.0, 0.02], [0.1, 0.0, 0.02], [0.1, 0.1, 0.02], [0.0, 0.1, 0.02]])
    thing = PerceivedObstacle(0, (square,), 100)
    points = np.array([[0.05, 0.05, 0.025], [0.05, 0.05, 0.05], [0.15, 0.05, 0.02], [0.05, -0.2, 0.02]])
    assert thing.explains(points, 0.01).tolist() == [True, False, False, False]
