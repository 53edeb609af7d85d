"""Links along the handle of a mesh: a half torus on a cylinder in closed form."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from perception.types import TriangleMesh
from sim_assets.objects.convex.perceived_handle import MOST_LINKS, handle_pieces
from sim_assets.objects.solids import Handle

BODY, HEIGHT, RING, THICK, WIDE = 0.04, 0.1, 0.025, 0.004, 0.006
Z = np.linspace(0.0, HEIGHT, 30)


def surface(mesh, offset=(0.0, 0.0)):
    return TriangleMesh(mesh.vertices + np.array([*offset, 0.0]), np.asarray(mesh.faces))


@pytest.fixture(scope="module")
def mug():
    body = trimesh.creation.cylinder(BODY, HEIGHT, sections=96).apply_translation((0, 0, HEIGHT / 2))
    angle = np.linspace(0.55 * np.pi, -0.55 * np.pi, 60)
    ring = np.stack([BODY + RING * np.cos(angle), HEIGHT / 2 + RING * np.sin(angle)], axis=1)
    handle = Handle(ring, np.full(60, THICK), np.full(60, WIDE), exponent=2.0)
    return trimesh.boolean.union([body, handle.mesh(48)], engine="manifold")


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.1, -0.05)])
def test_links_have_the_volume_and_extent_of_the_handle(mug, offset):
    """Half a torus of elliptic section: π a b times π R."""
    pieces = handle_pieces(surface(mug, offset), np.array(offset), Z, np.full(30, BODY))
    assert 3 <= len(pieces) <= MOST_LINKS
    volume = sum(ConvexHull(piece).volume for piece in pieces)
    assert volume == pytest.approx(np.pi * THICK * WIDE * np.pi * RING, rel=0.12)
    corners = np.concatenate(pieces) - (*offset, HEIGHT / 2)
    assert corners[:, 0].max() == pytest.approx(BODY + RING + THICK, abs=1.5e-3)
    np.testing.assert_allclose([corners[:, 1].min(), corners[:, 1].max()], (-WIDE, WIDE), atol=1e-3)
    np.testing.assert_allclose(
        [corners[:, 2].min(), corners[:, 2].max()], (-RING - THICK, RING + THICK), atol=2e-3
    )


def test_hole_stays_free(mug):
    pieces = handle_pieces(surface(mug), np.zeros(2), Z, np.full(30, BODY))
    hole = np.array([(BODY + x, 0.0, HEIGHT / 2 + z) for x in (0.005, 0.015) for z in (-0.008, 0.0, 0.008)])
    for piece in pieces:
        equations = ConvexHull(piece).equations
        assert ((hole @ equations[:, :3].T + equations[:, 3]).max(axis=1) > 0).all()


def test_a_body_without_a_handle_has_no_links():
    body = trimesh.creation.cylinder(BODY, HEIGHT, sections=96).apply_translation((0, 0, HEIGHT / 2))
    assert handle_pieces(surface(body), np.zeros(2), Z, np.full(30, BODY)) == []
