"""Name and bounds of a thing of no class."""

import numpy as np

from perception.obstacles.obstacle import PerceivedObstacle


def test_the_bounds_hold_all_pieces():
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    thing = PerceivedObstacle(3, (corners, corners + np.array((2, 0, 0))), 10)
    assert thing.name == "thing_3"
    np.testing.assert_allclose(thing.bounds, [(0, 0, 0), (3, 1, 1)])
