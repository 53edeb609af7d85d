"""Rigid bodies of estimates: mass properties in closed form, and the text of numbers and OBJ files."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from app.export.model import FRICTION, hull_obj, numbers, obj_text, rigid_model
from perception.types import ObjectEstimate, TriangleMesh
from sim_assets.objects.convex.perceived_mesh import pieces_volume

RADIUS, HEIGHT, DENSITY = 0.03, 0.12, 700.0


@pytest.fixture(scope="module")
def cylinder():
    """A can whose base, not whose centre, is the origin of its frame."""
    mesh = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=128)
    mesh.apply_translation((0.0, 0.0, HEIGHT / 2))
    surface = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    T = np.eye(4)
    T[:3, 3] = (0.4, 0.1, 0.2)
    return rigid_model(ObjectEstimate(3, "can", np.zeros(16), T, np.full(3, 0.06), surface))


def test_mass_properties_are_those_of_a_homogeneous_cylinder(cylinder):
    """m = ρ π r² h; m (3 r² + h²) / 12 across and m r² / 2 along the axis, about the centre of mass."""
    mass = DENSITY * np.pi * RADIUS**2 * HEIGHT
    across, along = mass * (3 * RADIUS**2 + HEIGHT**2) / 12, mass * RADIUS**2 / 2
    assert cylinder.mass == pytest.approx(mass, rel=2e-3)
    assert cylinder.volume == pytest.approx(mass / DENSITY, rel=2e-3)
    np.testing.assert_allclose(cylinder.center, (0, 0, HEIGHT / 2), atol=1e-9)
    np.testing.assert_allclose(cylinder.inertia, np.diag([across, across, along]), rtol=3e-3, atol=1e-9)


def test_pieces_fill_the_object_in_its_own_frame(cylinder):
    assert cylinder.name == "can_3"
    assert pieces_volume(cylinder.pieces) == pytest.approx(cylinder.volume, rel=0.02)
    corners = np.concatenate(cylinder.pieces)
    np.testing.assert_allclose([corners[:, 2].min(), corners[:, 2].max()], [0, HEIGHT], atol=1e-9)
    np.testing.assert_allclose(corners[:, :2].mean(axis=0), 0, atol=1e-4)


def test_contact_is_that_of_ceramics_and_cardboard():
    assert FRICTION == (0.6, 0.005, 0.0001)  # sliding, torsional [m], rolling [m]


def test_numbers_are_rounded_to_significant_digits():
    assert numbers((1.0, -0.123456789, 1e-9)) == "1 -0.1234568 1e-09"
    assert numbers(np.array([[1 / 3, 2], [3, 4]]), 3) == "0.333 2 3 4"


def test_obj_indices_start_at_one():
    text = obj_text(np.array([(0, 0, 0), (1, 0, 0), (0, 0.25, 0)]), np.array([(0, 1, 2)]))
    assert text.splitlines() == [
        "v 0.0000000 0.0000000 0.0000000",
        "v 1.0000000 0.0000000 0.0000000",
        "v 0.0000000 0.2500000 0.0000000",
        "f 1 2 3",
    ]
    assert text.endswith("\n")


def test_hull_of_a_piece_is_closed_and_wound_outwards(tmp_path):
    (tmp_path / "cube.obj").write_text(hull_obj(np.array(list(np.ndindex(2, 2, 2)), dtype=float)))
    cube = trimesh.load(tmp_path / "cube.obj", force="mesh")
    assert cube.is_watertight and cube.volume == pytest.approx(1.0)
