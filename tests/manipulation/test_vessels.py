from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Delaunay

from manipulation.hulls import convex_pieces
from manipulation.standing import to_standing
from manipulation.vessels import holds, vessel_pieces
from perception.geometry import pose_from_yaw


@pytest.fixture(scope="module")
def bowl(shapes):
    return to_standing(shapes.estimate(1, "bowl", shapes.bowl(), x=0.5, y=-0.2))


def inside(pieces, points):
    return np.any([Delaunay(piece).find_simplex(points) >= 0 for piece in pieces], axis=0)


def placed(shapes, x=0.5, y=-0.2, z=0.0):
    can = to_standing(shapes.estimate(2, "can", shapes.can(0.02, 0.08)))
    return can, pose_from_yaw(0.0, np.array([x, y, z]))


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ({"z": 0.01}, True),
        ({"x": 0.55, "z": 0.02}, True),  # leans on the wall
        ({}, False),  # estimates overlap, but it stands on the table
        ({"z": 0.06}, False),  # on the rim
        ({"x": 0.65, "z": 0.02}, False),  # on a neighbour
    ],
)
def test_a_vessel_holds_what_has_its_lowest_point_in_the_cavity(shapes, bowl, place, expected):
    assert holds(bowl, bowl.T_world_stand, [placed(shapes, **place)]) is expected


def test_only_upright_bowls_and_mugs_hold_something(shapes, bowl):
    content = [placed(shapes, z=0.01)]
    assert not holds(replace(bowl, category="can"), bowl.T_world_stand, content)
    overturned = bowl.T_world_stand @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert not holds(bowl, overturned, content)
    assert not holds(bowl, bowl.T_world_stand, [])


@pytest.mark.parametrize("category", ["bowl", "mug"])
def test_pieces_enclose_the_mesh_and_leave_the_cavity_free(shapes, category):
    vessel = to_standing(shapes.estimate(1, category, getattr(shapes, category)()))
    pieces = vessel_pieces(vessel)
    surface = vessel.vertices[vessel.faces].mean(axis=1)
    away = surface[:, 2] < vessel.top - 0.003
    assert inside([1.02 * p - 0.02 * p.mean(axis=0) for p in pieces], surface[away]).mean() > 0.98
    radius = np.ptp(vessel.vertices[:, 1]) / 2
    heights = np.linspace(0.35, 1.2, 12) * vessel.top
    axis = np.stack([np.zeros(12), np.zeros(12), heights], axis=1)
    cavity = np.concatenate(
        [axis + radius * np.array([dx, dy, 0]) for dx, dy in ((0, 0), (0.4, 0), (0, -0.4))]
    )
    assert not inside(pieces, cavity).any()
    assert inside(convex_pieces(vessel), axis[:6]).all(), "one hull is not enough"


def test_the_handle_of_a_mug_is_a_piece(shapes):
    mug = to_standing(shapes.estimate(1, "mug", shapes.mug()))
    reach = mug.vertices[:, 0].max()
    assert max(piece[:, 0].max() for piece in vessel_pieces(mug)) == pytest.approx(reach)


def test_a_mesh_without_a_cavity_is_one_hull(shapes):
    full = replace(to_standing(shapes.estimate(1, "can", shapes.can())), category="bowl")
    pieces = vessel_pieces(full)
    assert len(pieces) == 1 and len(pieces[0]) == len(convex_pieces(full)[0])


def test_an_uneven_rim_leaves_the_cavity_free(shapes, bowl):
    """As estimated shapes have it: near its highest place there is no closed ring of wall."""
    x, y, z = bowl.vertices.T
    tilted = np.stack([x, y, z * (1 + 0.08 * x / np.abs(x).max())], axis=1)
    uneven = replace(bowl, vertices=tilted)
    pieces = vessel_pieces(uneven)
    assert len(pieces) > 1
    axis = np.stack([np.zeros(8), np.zeros(8), np.linspace(0.4, 1.0, 8) * bowl.top], axis=1)
    assert not inside(pieces, axis).any()
