"""Free places in a box: room around them, distances kept, none in a full box."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.footprints import BoxRaster
from manipulation.free_places import (
    APART,
    BESIDE,
    BETWEEN,
    ENOUGH,
    GAPS,
    MOST,
    NARROW,
    Hold,
    free_places,
    roomier_place,
)
from manipulation.grasps import grasp_candidates
from manipulation.robot import GripperGeometry
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


def test_the_snuggest_place_is_in_a_corner_and_beside_what_is_there(can):
    def from_corner(place):
        return np.array(BOX.size[:2]) / 2 - np.abs(np.array(place.position[:2]) - BOX.center)

    place = free_places(can, GOAL, [], BOX, is_snug=True)[0]
    assert (from_corner(place) < radius_of(can) + GAPS[0] + 2 * CELL).all()
    corners = [(can, at(0.5 + x, 0.3 + y)) for x in (-0.105, 0.105) for y in (-0.055, 0.055)][:3]
    (x, y) = free_places(can, GOAL, corners, BOX, is_snug=True)[0].position[:2]
    assert x > 0.5 and y > 0.3, "the last corner"


def test_objects_on_the_table_take_no_room(can):
    beside = [(can, at(0.5, -0.25)), (can, at(0.1, 0.3))]
    assert free_places(can, GOAL, beside, BOX) == free_places(can, GOAL, [], BOX)


def test_places_leave_the_goals_of_waiting_objects_free_where_there_are_others(can):
    later = Placement("can_2", (0.56, 0.3, 0.0), (0.0,))
    places = free_places(can, GOAL, [], BOX, [(can, later)])
    points = np.array([place.position[:2] for place in places])
    assert (np.linalg.norm(points - later.position[:2], axis=1) > 2 * radius_of(can) + GAPS[1] - CELL).all()
    full = [(can, at(0.5 + x, 0.3 + y)) for x in (-0.11, -0.03) for y in (-0.06, 0.02)]
    only = free_places(can, GOAL, full, BOX)
    assert only and free_places(can, GOAL, full, BOX, [(can, replace(later, position=only[0].position))])


def test_a_full_box_has_no_place(can):
    small = Box(center=(0.5, 0.3), size=(0.10, 0.10, 0.08))
    assert free_places(can, GOAL, [(can, at(0.5, 0.3))], small) == []


def test_a_tight_box_has_places_with_the_smaller_gap(can):
    side = 2 * radius_of(can) + sum(GAPS)
    tight = Box(center=(0.5, 0.3), size=(side, side, 0.08))
    (place, *_) = free_places(can, GOAL, [], tight)
    assert np.abs(np.array(place.position[:2]) - tight.center).max() < GAPS[0] - GAPS[1]


def test_places_without_room_for_the_hand_come_last(can, monkeypatch):
    def count(raster, grasps, pose, gripper):
        return int(pose.position[0] > 0.01)

    monkeypatch.setattr("manipulation.free_places.count_free_releases", count)
    assert free_places(can, GOAL, [], BOX)[0].position[0] < 0.51
    places = free_places(can, GOAL, [], BOX, hold=Hold((), GripperGeometry()))
    has_room = [place.position[0] > 0.51 for place in places]
    assert has_room[0] and has_room == sorted(has_room, reverse=True)


@pytest.mark.parametrize(("height", "has_room"), [(0.08, True), (0.30, False)])
def test_between_high_walls_there_is_no_room_for_the_hand(can, height, has_room):
    box = replace(BOX, size=(0.12, 0.12, height))
    hold = Hold(grasp_candidates(can).grasps, GripperGeometry())
    assert hold.has_room(GOAL, BoxRaster(box, 0.0), box) == has_room


def test_a_place_with_enough_room_is_kept(can):
    other = at(0.5 - 2 * radius_of(can) - ENOUGH - CELL, 0.3)
    assert roomier_place(can, GOAL, [(can, other)], [], BOX) is GOAL


@pytest.mark.parametrize("gap", [0.006, 0.001, -0.006])
def test_a_place_beside_what_moved_is_shifted_away_from_it(can, gap):
    other = at(0.5 - 2 * radius_of(can) - gap, 0.3)
    x, y, z = roomier_place(can, GOAL, [(can, other)], [], BOX).position
    assert x - other[0, 3] - 2 * radius_of(can) > NARROW[0] - CELL
    assert np.hypot(x - 0.5, y - 0.3) <= BESIDE and z == BOX.floor


def test_a_shifted_place_leaves_room_for_what_comes_later(can):
    other, between = at(0.5 - 2 * radius_of(can) - 0.001, 0.3), 0.004
    later = Placement("can_2", (0.5 + 2 * radius_of(can) + between, 0.3, 0.0), (0.0,))
    place = np.array(roomier_place(can, GOAL, [(can, other)], [(can, later)], BOX).position[:2])
    assert np.linalg.norm(place - later.position[:2]) > 2 * radius_of(can) + BETWEEN - CELL
    assert np.linalg.norm(place - other[:2, 3]) > 2 * radius_of(can) + NARROW[-1] - CELL


def test_without_a_better_place_the_planned_one_is_kept(can):
    side = 2 * radius_of(can) + 0.004
    assert roomier_place(can, GOAL, [], [], Box(center=(0.5, 0.3), size=(side, side, 0.08))) is GOAL
    around = [(can, at(0.5 + dx, 0.3)) for dx in (-2 * radius_of(can), 2 * radius_of(can))]
    low = Box(center=(0.5, 0.3), size=(0.3, 2 * radius_of(can) + 0.006, 0.08))
    assert roomier_place(can, GOAL, around, [], low) is GOAL


def test_a_box_contains_what_is_between_its_walls():
    assert BOX.contains(at(0.36, 0.21)) and BOX.contains(at(0.64, 0.39))
    assert not BOX.contains(at(0.34, 0.3)) and not BOX.contains(at(0.5, 0.41))
