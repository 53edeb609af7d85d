"""Outlines and gaps of known shapes; the memory of meshes that are no longer in use."""

import gc
import weakref

import numpy as np
import pytest
import trimesh

from sim_assets.cell.outlines import gap, outline


def cylinder(radius):
    return trimesh.creation.cylinder(radius, 0.1, sections=64)


def mug() -> trimesh.Trimesh:
    """A cylinder with a thin bar for a handle, out to x = 0.08."""
    bar = trimesh.creation.box((0.04, 0.01, 0.05), transform=np.eye(4))
    bar.apply_translation((0.06, 0, 0))
    together = trimesh.util.concatenate([cylinder(0.04), bar])
    assert isinstance(together, trimesh.Trimesh)
    return together


def square(center, half):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    return corners * half + center


def test_outline_follows_the_handle_and_not_its_hull():
    polygon = outline(mug())
    assert polygon[:, 0].max() == pytest.approx(0.08, abs=1e-3)
    assert polygon[:, 1].max() == pytest.approx(0.04, abs=1e-3)
    beyond = polygon[polygon[:, 0] > 0.05]
    assert np.abs(beyond[:, 1]).max() < 0.0065  # a convex hull would be 0.02 wide here


def test_gap_of_squares():
    assert gap(square((0, 0), 0.1), square((0.5, 0), 0.1)) == pytest.approx(0.3)
    assert gap(square((0, 0), 0.1), square((0.3, 0.3), 0.1)) == pytest.approx(0.1 * np.sqrt(2))
    assert gap(square((0, 0), 0.1), square((0.05, 0.05), 0.1)) == 0
    assert gap(square((0, 0), 0.1), square((0, 0), 0.01)) == 0
    cross = square((0, 0), np.array([0.3, 0.01])), square((0, 0), np.array([0.01, 0.3]))
    assert gap(*cross) == 0


def test_outlines_do_not_keep_their_meshes():
    mesh = mug()
    assert outline(mesh) is outline(mesh)
    alive = weakref.ref(mesh)
    del mesh
    gc.collect()
    assert alive() is None
