"""Building blocks: closed-form sizes and volumes, outward normals, coordinates in their cells."""

import numpy as np
import pytest

from sim_assets.datasets.distractors.shapes import (
    ball,
    between,
    box,
    cylinder,
    hull,
    lathe,
    loft,
    mapped,
    moved,
    rounded_box,
    sheet,
    standing,
    thing,
    tube,
    turned,
)
from sim_assets.rendering.texture_coordinates import ATTRIBUTE

CIRCLE = np.linspace(0, 2 * np.pi, 32, endpoint=False)
RING = np.stack([np.cos(CIRCLE), np.sin(CIRCLE), 0 * CIRCLE], axis=1)


def test_a_turned_box_keeps_its_volume_and_middle():
    mesh = box((0.1, 0.2, 0.3), (1, 2, 3), yaw=0.4)
    assert mesh.volume == pytest.approx(0.006)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), (1, 2, 3))
    assert mesh.extents[0] == pytest.approx(0.1 * np.cos(0.4) + 0.2 * np.sin(0.4))


def test_rod_reaches_from_point_to_point():
    first, last = np.array([0.1, 0.0, 0.2]), np.array([0.4, 0.4, 0.2])
    mesh = between(first, last, 0.01, around=16)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), (first + last) / 2, atol=1e-9)
    assert (mesh.vertices @ (0.6, 0.8, 0)).max() == pytest.approx(last @ (0.6, 0.8, 0) + 0.01, abs=1e-6)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_cylinder_lies_along_its_axis(axis):
    extents = cylinder(0.1, 1.0, axis=axis, around=32).extents
    assert extents["xyz".index(axis)] == pytest.approx(1.0)
    assert sorted(extents)[:2] == pytest.approx([0.2, 0.2], abs=0.01)


@pytest.mark.parametrize("reverse", [False, True])
def test_normals_point_outwards_whatever_the_order_of_the_points(reverse):
    step = -1 if reverse else 1
    rings = np.stack([RING, RING + np.array([0, 0, 1])])[::step]
    profile = [(0, 0), (1, 0), (1, 1), (0, 1)][::step]
    grid = np.stack(np.meshgrid([0, 1, 2], [0, 1.0, 2], indexing="ij"), axis=-1)
    top = np.concatenate([grid, 0 * grid[..., :1]], axis=-1)[::step]
    assert loft(rings).volume == pytest.approx(np.pi, rel=0.01)
    assert lathe(profile, 64).volume == pytest.approx(np.pi, rel=0.01)
    assert sheet(top, 0.1).volume == pytest.approx(0.4)
    assert sheet(top, 0.1).is_watertight


def test_tube_has_the_volume_of_its_path():
    path = np.stack([np.linspace(0, 1, 20), 0 * np.linspace(0, 1, 20), np.full(20, 0.5)], axis=1)
    assert tube(path, 0.1, 24).volume == pytest.approx(np.pi * 0.01, rel=0.03)


def test_ball_and_hull_and_rounded_box():
    np.testing.assert_allclose(ball((1, 2, 3)).extents, (2, 4, 6), rtol=0.01)
    assert hull(box((1, 1, 1)).vertices).volume == pytest.approx(1)
    mesh = rounded_box((0.1, 0.2, 0.3), 0.02)
    np.testing.assert_allclose(mesh.extents, (0.1, 0.2, 0.3), rtol=0.02)
    assert 0.9 < mesh.volume / 0.006 < 1 and mesh.is_watertight


def test_turned_moved_standing():
    mesh = moved(turned(box((0.2, 0.4, 0.6)), np.pi / 2, (1, 0, 0)), 3, 3, 3)
    np.testing.assert_allclose(mesh.extents, (0.2, 0.6, 0.4))
    np.testing.assert_allclose(standing(mesh).bounds, [(-0.1, -0.3, 0), (0.1, 0.3, 0.4)], atol=1e-12)


def test_a_thing_has_a_cell_for_each_surface_and_three_for_a_print():
    mesh = thing(("wood", [ball(0.1)]), ("print", [turned(box((1, 1, 1)), 0.3)]), ("metal", [ball(0.2)]))
    assert mesh.metadata["surfaces"] == ("wood", "print", "print", "print", "metal")
    uv = mesh.face_attributes[ATTRIBUTE].mean(axis=1)
    cell = np.floor(uv[:, 1] * 2) * 3 + np.floor(uv[:, 0] * 3)
    assert (cell[:320] == 0).all() and (cell[332:] == 4).all()
    assert np.bincount(cell[320:332].astype(int)).tolist() == [0, 4, 4, 4]  # 4 triangles along each axis
    copied = mesh.copy()
    copied.apply_translation((1, 0, 0))
    np.testing.assert_array_equal(copied.face_attributes[ATTRIBUTE], mesh.face_attributes[ATTRIBUTE])


def test_too_many_surfaces_are_refused():
    with pytest.raises(ValueError, match="7 surfaces, but an atlas has 6 cells"):
        thing(*[("wood", [mapped(box((1, 1, 1)))])] * 7)
