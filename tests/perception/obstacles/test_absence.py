"""A box of 6 cm seen obliquely: there, gone, hidden, and too flat to tell."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from perception.obstacles.absence import seen_through
from perception.obstacles.obstacle import PerceivedObstacle


def thing(height=0.06):
    corners = itertools.product((-0.03, 0.03), (-0.02, 0.02), (0.0, height))
    return PerceivedObstacle(0, (np.array(list(corners)),), 500)


@pytest.fixture(scope="module")
def camera(scenes):
    return scenes.orbit((0, 0, 0.03), 0.4, 60, 30)


def image(scenes, camera, *solids):
    return scenes.render(list(solids), camera).frame


def test_what_is_there_is_not_seen_through_and_what_is_gone_is(scenes, camera):
    box = scenes.Solid(0.0, 0.0, 0.06, half=(0.03, 0.02))
    away = scenes.Solid(0.2, 0.0, 0.06, half=(0.03, 0.02))
    there, gone = (seen_through(thing(), image(scenes, camera, solid)) for solid in (box, away))
    assert there is not None and gone is not None
    assert there < 0.1 and gone > 0.9


def test_nothing_is_known_of_what_a_hand_hides_or_of_what_is_flat(scenes, camera):
    empty = image(scenes, camera)
    hidden = replace(empty, depth=np.full_like(empty.depth, 0.15))
    assert seen_through(thing(), hidden) is None
    assert seen_through(thing(), replace(empty, depth=np.zeros_like(empty.depth))) is None
    assert seen_through(thing(height=0.02), empty) is None
    behind = replace(empty, T_world_camera=empty.T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert seen_through(thing(), behind) is None
