"""Free places in a box: room around them, distances kept, none in a full box."""

import numpy as np
import pytest

from manipulation.free_places import APART, GAPS, MOST, free_places
from manipulation.standing import to_standing
from manipulation.types import Box, Placement
from perception.geometry import pose_from_yaw

BOX = Box(center=(0.5, 0.3), size=(0.30, 0.20, 0.08))
CELL = 0.005
GOAL = Placement("can_1", (0.5, 0.3, 0.0), (0.0,))


@pytest.fixture(scope="module")
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))


def at(x, y):
    return pose_from_yaw(0.0, np.array([x, y, 0.0]))


def radius_of(can):
    return float(np.linalg.norm(can.vertices[:, :2], axis=1).max())


def test_an_empty_box_has_most_room_in_its_middle(can):
    places = free_places(can, GOAL, [], BOX)
    assert len(places) == MOST
    assert places[0].position[1] == pytest.approx(0.3, abs=2 * CELL)
    assert places[0].position[2] == BOX.floor and places[0].yaws == GOAL.yaws


def test_places_keep_their_distance_from_walls_objects_and_each_other(can):
    other = at(0.42, 0.28)
    places = free_places(can, GOAL, [(can, other)], BOX)
    points = np.array([place.position[:2] for place in places])
    radius = radius_of(can)
    assert (np.linalg.norm(points - other[:2, 3], axis=1) > 2 * radius + GAPS[0] - 2 * CELL).all()
    free = np.array(BOX.size[:2]) / 2 - radius - GAPS[0] + 2 * CELL
    assert (np.abs(points - BOX.center) < free).all()
    assert places[0].position[0] > 0.5  # on the far side of the other
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1) + np.eye(len(points))
    assert apart.min() >= APART


def test_objects_on_the_table_take_no_room(can):
    beside = [(can, at(0.5, -0.25)), (can, at(0.1, 0.3))]
    assert free_places(can, GOAL, beside, BOX) == free_places(can, GOAL, [], BOX)


def test_a_full_box_has_no_place(can):
    small = Box(center=(0.5, 0.3), size=(0.10, 0.10, 0.08))
    assert free_places(can, GOAL, [(can, at(0.5, 0.3))], small) == []


def test_a_tight_box_has_places_with_the_smaller_gap(can):
    side = 2 * radius_of(can) + sum(GAPS)
    tight = Box(center=(0.5, 0.3), size=(side, side, 0.08))
    (place, *_) = free_places(can, GOAL, [], tight)
    assert np.abs(np.array(place.position[:2]) - tight.center).max() < GAPS[0] - GAPS[1]
