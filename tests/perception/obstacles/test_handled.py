"""A bar with a thinner one that begins at its side, in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.obstacles.handled import with_handle
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh
from tests.perception.obstacles.test_crossed import BLUE, DARK_GREEN, GREEN, GREY, HALF, LENGTH, bar, painted

THIN, LONG = 0.018, 0.12  # radius and length of the handle in [m]


def handle(gap=0.001, angle=0.0, radius=THIN, middle=0.0):
    """The handle as it is estimated, its axis at an angle [deg] from x, ``gap`` [m] beside the bar."""
    shape = trimesh.creation.cylinder(radius, LONG, sections=24).subdivide().subdivide()
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    T = np.eye(4)
    T[:3, :3] = [[0, -s, c], [0, c, s], [-1, 0, 0]]
    reach = c * LONG / 2 + s * radius
    T[:3, 3] = HALF + gap + reach + middle, 0.0, radius
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    return ObjectEstimate(7, "bottle", np.zeros(16), T, np.full(3, 0.1), mesh, resting="lying")


@pytest.fixture
def found(scenes):
    """A function that returns the ids of the objects that have a piece as their handle."""
    solids = [
        scenes.Solid(x=0.0, y=0.0, height=2 * HALF, half=(HALF, LENGTH / 2)),
        scenes.Solid(x=HALF + LONG / 2, y=0.0, height=2 * THIN, half=(LONG / 2, THIN)),
    ]

    def run(*pieces, objects=(bar(),), body=GREEN, grip=DARK_GREEN):
        frames = painted(scenes, solids, body, grip, body)
        return with_handle(objects, pieces, frames, SupportPlane())

    return run


def test_a_thin_piece_that_begins_at_the_side_of_a_body_in_its_colour_is_its_handle(found):
    assert found(handle()) == {3}
    assert found(handle(angle=30)) == {3}


@pytest.mark.parametrize(
    "piece",
    [handle(gap=0.01), handle(angle=60), handle(radius=0.024), handle(middle=-HALF - LONG / 2),
     replace(handle(), resting="upright")],
    ids=["apart", "along-it", "thick", "across-it", "upright"],
)  # fmt: skip
def test_other_pieces_are_none(found, piece):
    assert found(piece) == set()


@pytest.mark.parametrize("grip", [GREY, BLUE, tuple(2 * c for c in GREEN)])
def test_what_has_another_colour_is_none(found, grip):
    assert found(handle(), grip=grip) == set()


def test_other_objects_have_none(found):
    for other in (bar(resting="upright"), bar(category="mug"), replace(bar(), id=7)):
        assert found(handle(), objects=(other,)) == set()


def test_a_slender_object_is_a_handle_too_and_a_part_of_the_same_thing(found):
    for category in ("bottle", "can", "mug"):
        slender = replace(handle(radius=0.65 * HALF), category=category)
        assert found(objects=(bar(), slender)) == {3, 7}


def test_objects_of_one_product_or_of_other_colours_are_no_handles(found):
    slender = handle(radius=0.65 * HALF)
    assert found(objects=(bar(), handle(radius=HALF))) == set()
    assert found(objects=(bar(), slender), grip=BLUE) == set()
    assert found(objects=(bar(), replace(slender, resting="upright"))) == set()


def test_a_piece_never_makes_an_object_of_its_number_a_part(found):
    other = replace(bar(resting="upright"), id=7)
    assert found(handle(), objects=(bar(), other)) == {3}
