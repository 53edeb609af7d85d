"""Convex pieces of boxes, an L and flat sheets, on voxels of a lattice."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from perception.obstacles.convex import ConvexConfig, convex_pieces
from perception.obstacles.volume import Solid

VOXEL = 0.005


def lattice(low, high):
    axes = [np.arange(a + VOXEL / 2, b, VOXEL) for a, b in zip(low, high)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def l_shape(angle=0.0):
    """An L of two bars of 10 x 2 x 2 cm, and the free space in its bounding box."""
    inside = lattice((0, 0, 0), (0.1, 0.1, 0.02))
    solid = (inside[:, 0] < 0.02) | (inside[:, 1] < 0.02)
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Solid(inside[solid] @ R.T, inside[~solid] @ R.T)


def covered(pieces, points, grown=1e-9):
    inside = np.zeros(len(points), dtype=bool)
    for piece in pieces:
        hull = ConvexHull(piece)
        inside |= (points @ hull.equations[:, :3].T + hull.equations[:, 3] <= grown).all(axis=1)
    return inside


def test_a_convex_solid_is_one_piece():
    box = Solid(lattice((0, 0, 0), (0.05, 0.1, 0.08)), lattice((0.06, 0, 0), (0.1, 0.1, 0.1)))
    (piece,) = convex_pieces(box)
    assert ConvexHull(piece).volume == pytest.approx(0.045 * 0.095 * 0.075, rel=1e-6)


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_an_l_is_cut_into_pieces_that_cover_it_and_little_else(angle):
    solid = l_shape(angle)
    pieces = convex_pieces(solid)
    assert 2 <= len(pieces) <= 4
    # between two pieces lies at most the distance of neighbouring voxels
    assert covered(pieces, solid.points, VOXEL).all()
    assert covered(pieces, solid.free, -VOXEL / 2).mean() < 0.05
    assert len(convex_pieces(solid, config=ConvexConfig(max_pieces=1))) == 1


def test_pieces_keep_off_forbidden_points():
    """What stands in the corner of the L keeps its place, although a coarser tolerance would accept it."""
    solid, loose = l_shape(), ConvexConfig(max_free=1.0, min_free=1e-5)
    standing = lattice((0.03, 0.03, 0), (0.04, 0.04, 0.02))
    assert covered(convex_pieces(Solid(solid.points, np.zeros((0, 3))), config=loose), standing).any()
    strict = ConvexConfig(max_free=0.0, min_free=0.0)
    assert not covered(convex_pieces(Solid(solid.points, np.zeros((0, 3))), standing, strict), standing).any()


@pytest.mark.parametrize("rounding", [0.0, 4e-6])
def test_a_flat_sheet_has_the_thickness_of_a_voxel(rounding):
    """One that is flat but for rounding as well: parts of it may have no convex hull."""
    sheet = lattice((0, 0, 0.01), (0.1, 0.05, 0.015))
    sheet[:, 2] += rounding * np.random.default_rng(0).uniform(-1, 1, len(sheet))
    (piece,) = convex_pieces(Solid(sheet, np.zeros((0, 3))))
    assert np.ptp(piece, axis=0) == pytest.approx((0.1, 0.05, VOXEL), rel=5e-3)


def test_nothing_solid_has_no_pieces():
    assert convex_pieces(Solid(np.zeros((0, 3)), np.zeros((0, 3)))) == ()
