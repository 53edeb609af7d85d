"""Convex pieces by halving: they fill the surface, leave hollows open, and stop where nothing is gained."""

import numpy as np
import pytest
import trimesh

from perception.obstacles.obstacle import is_within
from sim_assets.objects.convex.halving import halved_pieces


def volume(pieces):
    return sum(trimesh.convex.convex_hull(piece).volume for piece in pieces)


def test_a_convex_part_is_one_piece():
    ball = trimesh.creation.icosphere(radius=0.05)
    (piece,) = halved_pieces(ball)
    assert trimesh.convex.convex_hull(piece).volume == pytest.approx(ball.volume, rel=1e-4)


def test_an_angle_is_cut_where_it_bends():
    corners = [(0.1, 0.02, 0.03), (0.02, 0.1, 0.03)]
    bars = [trimesh.creation.box(bounds=[(0, 0, 0), corner]) for corner in corners]
    angle = trimesh.boolean.union(bars, engine="manifold")
    pieces = halved_pieces(angle)
    assert volume(pieces) == pytest.approx(angle.volume, rel=0.15)
    assert not any(is_within(np.array([[0.06, 0.06, 0.015]]), piece).any() for piece in pieces)


@pytest.mark.parametrize("depth", [0.003, 0.006])
def test_a_straight_hollow_stays_open(depth):
    tube = trimesh.creation.annulus(r_min=0.037, r_max=0.04, height=0.08)
    pieces = halved_pieces(tube, depth)
    inside = np.array([[0.02, 0, 0], [0, -0.02, 0.03], [0, 0, -0.03]])
    wall = np.array([[0.0385, 0, 0], [0, -0.0385, 0.03], [-0.0385, 0, -0.03]])
    assert not any(is_within(inside, piece).any() for piece in pieces)
    assert np.any([is_within(wall, piece, 1e-4) for piece in pieces], axis=0).all()


def test_fewer_halvings_or_deeper_dents_make_fewer_pieces():
    ring = trimesh.creation.torus(0.05, 0.006)
    counts = [len(halved_pieces(ring, *limits)) for limits in ((0.003, 6), (0.01, 6), (0.003, 1), (0.003, 0))]
    assert counts[0] > counts[1] > counts[3] == 1 and counts[0] > counts[2] == 2
    assert volume(halved_pieces(ring)) < 1.6 * ring.volume


def test_an_open_surface_is_its_hull():
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.update_faces(np.arange(len(box.faces)) > 1)
    (piece,) = halved_pieces(box)
    assert trimesh.convex.convex_hull(piece).volume == pytest.approx(0.001)
