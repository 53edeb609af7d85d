"""Things of no class in the 3-D scene."""

import numpy as np
import pytest

from app.viewer.display import DisplayOptions
from app.viewer.obstacle_layer import ObstacleLayer, surface
from app.viewer.snapshot import Snapshot

CUBE = np.array([(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)], dtype=float)


def test_each_piece_is_a_hull_with_one_label_and_goes_with_its_thing(server, node):
    layer = ObstacleLayer(server)
    layer.draw(Snapshot(obstacles={"thing_0": (CUBE, CUBE + np.array((0.1, 0, 0)))}), DisplayOptions())
    assert len(node("/obstacles/thing_0/0").vertices) == 8 and node("/obstacles/thing_0/1") is not None
    assert node("/obstacles/thing_0/label").text == "thing 0 · of no class"
    np.testing.assert_allclose(node("/obstacles/thing_0/label").position, (0.1, 0.05, 0.12))
    layer.draw(Snapshot(obstacles={"thing_0": (CUBE,)}), DisplayOptions(objects="true", labels=False))
    assert node("/obstacles/thing_0/1") is None and not node("/obstacles/thing_0/0").visible
    layer.draw(Snapshot(), DisplayOptions())
    assert node("/obstacles/thing_0/0") is None and node("/obstacles/thing_0/label") is None


def area(points, triangles):
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def test_flat_pieces_are_drawn_on_both_sides_and_lines_not_at_all():
    tilted = CUBE[CUBE[:, 2] == 0] @ np.linalg.qr(np.arange(9.0).reshape(3, 3) ** 2 + 1)[0]
    assert area(CUBE, surface(CUBE)) == pytest.approx(0.06)
    assert area(tilted, surface(tilted)) == pytest.approx(0.02)
    for points in (np.outer(np.arange(5.0), (1, 2, 3)), np.zeros((4, 3))):
        assert surface(points).shape == (0, 3)
