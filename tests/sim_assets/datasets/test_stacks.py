"""Stacks without physics: heights at rest of known solids, and the rules for what stands on what."""

from dataclasses import replace

import numpy as np
import pytest
from trimesh import creation, sample
from trimesh.transformations import rotation_matrix

from sim_assets.datasets.scatter import make_item
from sim_assets.datasets.stacks import Stacks, relief, sink

CUP, FLOOR, RIM = 0.05, 0.01, 0.09  # outer radius, height of the floor inside, height of the rim [m]


def cylinder(radius, height):
    return creation.cylinder(radius, height).apply_translation((0, 0, height / 2))


def cup():
    wall = creation.annulus(CUP - 0.004, CUP, RIM).apply_translation((0, 0, RIM / 2))
    return wall + cylinder(CUP, FLOOR)


def points(mesh):
    return np.asarray(sample.sample_surface(mesh, 20000, seed=1)[0])


@pytest.fixture
def pool():
    """A bowl, a can that fits into it, a mug too wide for it, and an item of no class."""
    return [
        make_item("bowl", cup()), make_item("can", cylinder(0.02, 0.08)),
        make_item("mug", cylinder(0.06, 0.08)), make_item(None, cylinder(0.03, 0.02)),
    ]  # fmt: skip


@pytest.mark.parametrize(("radius", "expected"), [(0.03, FLOOR), (0.07, RIM)])
def test_an_object_rests_on_the_floor_of_a_cup_or_on_its_rim(radius, expected):
    height = sink(points(cylinder(radius, 0.05)), relief(points(cup())))
    assert height == pytest.approx(expected, abs=1e-4)


def test_a_tilted_object_rests_on_its_lowest_point():
    leaning = cylinder(0.02, 0.1).apply_transform(rotation_matrix(np.radians(20), (1, 0, 0)))
    height = sink(points(leaning), relief(points(cylinder(0.2, 0.03))))
    assert height == pytest.approx(0.03 + 0.02 * np.sin(np.radians(20)), abs=1e-3)


def test_an_object_beside_another_does_not_rest_on_it():
    ground = relief(points(cylinder(0.03, 0.03)))
    for beside in ((0.2, 0, 0), (0.055, 0.055, 0)):  # the second is over a corner of the relief
        assert sink(points(cylinder(0.02, 0.1)) + np.array(beside), ground) is None


def test_wide_objects_and_other_pairs_make_no_stack(pool):
    stacks, rng = Stacks(pool), np.random.default_rng(0)
    assert stacks.rest(2, 0, rng) is None  # wider than the bowl
    assert stacks.rest(0, 3, rng) is None and stacks.rest(3, 0, rng) is None  # no class


def test_an_object_in_a_bowl_stands_or_leans_inside(pool):
    stacks, rng = Stacks(pool), np.random.default_rng(0)
    poses = [stacks.rest(1, 0, rng) for _ in range(40)]
    assert all(T is not None for T in poses)
    tilts = np.array([np.arccos(np.clip(T[2, 2], -1, 1)) for T in poses])
    assert 0.3 < (tilts < 1e-6).mean() < 0.9 and tilts.max() < np.radians(23)
    for T in poses:
        assert FLOOR - 1e-4 < T[2, 3] < RIM and np.hypot(*T[:2, 3]) < CUP / 2


def test_further_objects_stand_on_what_is_shown(pool):
    where = np.eye(4)
    where[:2, 3] = (0.3, -0.2)
    added = Stacks(pool).draw([0], [where], np.random.default_rng(2))
    assert list(added) == [1]  # the only one that makes a stack with the bowl
    np.testing.assert_allclose(added[1][:2, 3], (0.3, -0.2), atol=CUP / 2)
    again = Stacks(pool).draw([0], [where], np.random.default_rng(2))
    np.testing.assert_array_equal(added[1], again[1])


def test_objects_in_other_poses_neither_stand_on_nor_carry_others(pool):
    for ignored in (0, 1):
        items = [replace(item, ignored=index == ignored) for index, item in enumerate(pool)]
        assert not Stacks(items).draw([0], [np.eye(4)], np.random.default_rng(0))


def test_an_object_is_not_placed_into_a_tall_neighbour(pool):
    beside = np.eye(4)
    beside[0, 3] = 0.07  # its circle overlaps that of the can in the bowl
    tall = [*pool, make_item(None, cylinder(0.06, 0.3))]
    shown = ([0, 4], [np.eye(4), beside])
    assert not Stacks(tall).draw(*shown, np.random.default_rng(0))
    flat = [*pool, make_item(None, cylinder(0.06, 0.005))]
    assert Stacks(flat).draw(*shown, np.random.default_rng(0))
