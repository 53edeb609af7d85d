"""Things of no class in the 3-D scene."""

import numpy as np

from app.viewer.display import DisplayOptions
from app.viewer.obstacle_layer import ObstacleLayer
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
