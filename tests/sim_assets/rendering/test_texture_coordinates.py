"""Texture coordinates: once around z, along the faces of a box, and within the cells of an atlas."""

import numpy as np
import pytest
import trimesh

from sim_assets.rendering.texture_coordinates import CELLS, MARGIN, along_faces, around, faces, in_cell


def test_texture_goes_once_around_the_object_and_from_bottom_to_top():
    mesh = trimesh.creation.cylinder(0.03, 0.1, sections=32)
    uv = around(mesh).reshape(-1, 3, 2)
    corners = mesh.vertices[mesh.faces]
    np.testing.assert_allclose(uv[..., 1], corners[..., 2] / 0.1 + 0.5, atol=1e-9)
    azimuth = np.arctan2(corners[..., 1], corners[..., 0])
    off_axis = np.hypot(corners[..., 0], corners[..., 1]) > 1e-6
    turns = uv[..., 0] - (azimuth / (2 * np.pi) + 0.5)
    np.testing.assert_allclose(turns[off_axis], np.round(turns[off_axis]), atol=1e-9)
    sides = np.abs(mesh.face_normals[:, 2]) < 0.5
    assert np.ptp(uv[sides, :, 0], axis=1).max() == pytest.approx(1 / 32, abs=1e-6)  # also over the seam


def test_prints_on_a_box_are_upright_and_never_mirrored():
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    uv, axis = along_faces(mesh)
    corners = mesh.vertices[mesh.faces]
    upright = axis < 2
    np.testing.assert_allclose(uv[upright, :, 1], corners[upright, :, 2] / 0.3 + 0.5)
    edges = uv[:, 1:] - uv[:, :1]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    np.testing.assert_allclose(area, 1.0)  # anticlockwise seen from outside, each triangle half its face
    front = (axis == 0) & (mesh.face_normals[:, 0] > 0)
    np.testing.assert_allclose(uv[front, :, 0], corners[front, :, 1] / 0.2 + 0.5)


def test_cells_tile_the_atlas_from_the_bottom_left():
    square = np.array([[[0, 0], [1, 0], [1, 1.0]]])
    moved = [in_cell(square, np.array([cell]))[0] for cell in range(CELLS)]
    np.testing.assert_allclose(moved[0][0], (MARGIN / 3, MARGIN / 2))
    np.testing.assert_allclose(moved[4][2], ((2 - MARGIN) / 3, (2 - MARGIN) / 2))
    for first in range(CELLS):
        for second in range(first):
            gap = np.abs(moved[first].mean(axis=0) - moved[second].mean(axis=0))
            assert gap[0] > 0.3 or gap[1] > 0.45


def test_faces_of_a_box_wear_three_cells():
    uv = faces(trimesh.creation.box((1, 1, 1)), first=3)
    assert (uv[..., 1] > 0.5).all()  # the upper row
    assert np.bincount(np.floor(uv.mean(axis=1)[:, 0] * 3).astype(int)).tolist() == [4, 4, 4]
