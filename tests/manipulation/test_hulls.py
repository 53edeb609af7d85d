import numpy as np
import pytest

from manipulation.errors import ManipulationError
from manipulation.hulls import convex_pieces, hull_faces, reduced_hull
from manipulation.standing import to_standing


def test_mug_has_body_and_handle_as_pieces(shapes):
    body_piece, handle = convex_pieces(to_standing(shapes.estimate(1, "mug", shapes.mug())))
    assert body_piece[:, 0].max() < 0.042 and handle[:, 0].max() > 0.06
    assert len(body_piece) <= 96


def test_hull_of_a_sphere_is_reduced_and_wound_outwards():
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    corners = reduced_hull(directions / np.linalg.norm(directions, axis=1, keepdims=True), limit=48)
    assert 40 <= len(corners) <= 96
    a, b, c = (corners[hull_faces(corners).reshape(-1, 3)[:, i]] for i in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert 0.85 * 4.19 < volume < 4.19


def test_hulls_with_few_vertices_are_unchanged():
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    inside = np.array([[0.5, 0.5, 0.5]])
    hull = reduced_hull(np.concatenate([cube, inside]))
    assert {tuple(v) for v in hull} == {tuple(v) for v in cube}
    a, b, c = (cube[hull_faces(cube).reshape(-1, 3)[:, i]] for i in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(1.0)


def test_a_wide_sheet_with_a_low_apex_keeps_its_volume():
    """The apex is extreme within 2 degrees of the vertical, which no sampled direction is."""
    angle = 2 * np.pi * np.arange(200) / 200
    sheet = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), np.zeros(200)], axis=1)
    points = np.concatenate([sheet, [[0.0, 0.0, 0.004]]])
    reduced = reduced_hull(points)
    assert reduced[:, 2].max() == 0.004
    assert len(hull_faces(reduced)) % 3 == 0


def test_flat_meshes_are_an_error():
    with pytest.raises(ManipulationError, match="flat or too small"):
        reduced_hull(np.zeros((8, 3)))
