"""Scattered items: distances, bounds, simplification."""

import numpy as np
import pytest
from trimesh import creation

from sim_assets.cell.outlines import gap
from sim_assets.datasets.scatter import OUTLINE_POINTS, make_item, scatter, simplified


def test_item_has_an_even_outline_and_its_reach():
    item = make_item("can", creation.cylinder(radius=0.03, height=0.1, sections=64))
    steps = np.linalg.norm(np.diff(item.outline, axis=0), axis=1)
    assert item.outline.shape == (OUTLINE_POINTS, 2) and np.ptp(steps) < 1e-3
    assert item.reach == pytest.approx(0.03, abs=1e-3)


def test_items_keep_the_gap_within_the_square():
    rng = np.random.default_rng(0)
    items = [make_item("can", creation.cylinder(radius=0.03, height=0.1)) for _ in range(6)]
    poses = scatter(items, rng, gap=0.04, spread=0.25)
    placed = [(p, p.transform(i.outline)) for p, i in zip(poses, items, strict=True) if p]
    assert len(placed) == 6
    assert all(abs(p.x) <= 0.25 and abs(p.y) <= 0.25 for p, _ in placed)
    assert all(gap(a, b) >= 0.04 for i, (_, a) in enumerate(placed) for _, b in placed[:i])


def test_an_item_without_room_has_no_pose():
    items = [make_item("can", creation.cylinder(radius=0.05, height=0.1)) for _ in range(3)]
    poses = scatter(items, np.random.default_rng(0), gap=0.02, spread=0.01)
    assert [pose is None for pose in poses] == [False, True, True]


def test_simplified_mesh_is_the_same_solid_with_fewer_triangles():
    ball = creation.icosphere(subdivisions=4, radius=0.05)
    reduced = simplified(ball, 0.0005)
    assert len(reduced.faces) < 0.5 * len(ball.faces)
    assert reduced.volume == pytest.approx(ball.volume, rel=0.03)
