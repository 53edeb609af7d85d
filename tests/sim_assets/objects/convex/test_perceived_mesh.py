"""Convex pieces: volumes and sizes of reconstructed objects, and cavities that stay open."""

from __future__ import annotations

from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from manipulation.standing import body_axis
from perception.types import Category, TriangleMesh
from sim_assets.objects.convex import perceived_mesh
from sim_assets.objects.convex.perceived_mesh import PolarBody, pieces_volume


def convex_pieces(mesh: TriangleMesh, category: Category) -> list[np.ndarray]:
    return perceived_mesh.perceived_pieces(mesh, category, body_axis(mesh.vertices, mesh.faces, category))


def measure(mesh: TriangleMesh, category: Category) -> PolarBody:
    return perceived_mesh.measure(mesh, category, body_axis(mesh.vertices, mesh.faces, category))


Decoded = Callable[[Category], TriangleMesh]


def inside(pieces: list[np.ndarray], points: np.ndarray) -> np.ndarray:
    """Which points lie in some piece."""
    found = np.zeros(len(points), dtype=bool)
    for piece in pieces:
        equations = ConvexHull(piece).equations
        found |= (points @ equations[:, :3].T + equations[:, 3] <= 1e-9).all(axis=1)
    return found


@pytest.mark.parametrize("category", get_args(Category))
def test_volume_and_size_agree_with_the_mesh(decoded: Decoded, category: Category) -> None:
    mesh = decoded(category)
    pieces = convex_pieces(mesh, category)
    truth = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert pieces_volume(pieces) == pytest.approx(truth.volume, rel=0.02)
    extent = np.ptp(np.concatenate(pieces), axis=0)
    np.testing.assert_allclose(extent, truth.extents, rtol=0.025)
    assert extent[2] == pytest.approx(truth.extents[2], rel=1e-6)


@pytest.mark.parametrize("category", ["mug", "bowl"])
def test_cavity_stays_open_and_walls_stay_closed(decoded: Decoded, category: Category) -> None:
    mesh = decoded(category)
    body = measure(mesh, category)
    pieces = convex_pieces(mesh, category)
    rows = range(body.floor + 2, len(body.z) - 3)
    inner, outer = body.inner[rows].mean(axis=1), body.outer[rows].mean(axis=1)
    away = np.deg2rad(np.arange(70, 290, 11))  # from a handle
    for share, expected in ((0.0, False), (0.85, False)):
        radius = share * inner[:, None] * np.ones(len(away))
        assert inside(pieces, _polar(body, radius, away, rows)).any() == expected
    middle = 0.5 * (inner + outer)[:, None] * np.ones(len(away))
    assert inside(pieces, _polar(body, middle, away, rows)).mean() > 0.97


def _polar(body, radius: np.ndarray, azimuths: np.ndarray, rows: range) -> np.ndarray:
    xy = body.axis + radius[..., None] * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    z = np.broadcast_to(body.z[rows][:, None, None], (*radius.shape, 1))
    return np.concatenate([xy, z], axis=-1).reshape(-1, 3)


def test_a_mug_has_its_handle_with_a_free_hole(decoded: Decoded) -> None:
    mesh = decoded("mug")
    body = measure(mesh, "mug")
    pieces = convex_pieces(mesh, "mug")
    corners = np.concatenate(pieces)
    assert corners[:, 0].max() == pytest.approx(mesh.vertices[:, 0].max(), abs=2e-3)
    wall = body.axis[0] + body.outer[:, 0].max()
    line = np.linspace(wall + 1e-3, mesh.vertices[:, 0].max(), 60)
    height = 0.5 * (mesh.vertices[:, 2].min() + mesh.vertices[:, 2].max())
    hits = inside(pieces, np.stack([line, np.full(60, body.axis[1]), np.full(60, height)], axis=1))
    assert hits.any() and not hits[:3].any()


def test_closed_bodies_are_few_pieces_and_stand_on_a_flat_base(decoded: Decoded) -> None:
    pieces = convex_pieces(decoded("bottle"), "bottle")
    assert len(pieces) <= 12
    lowest = min(piece[:, 2].min() for piece in pieces)
    feet = [piece for piece in pieces if np.isclose(piece[:, 2].min(), lowest)]
    assert len(feet) == 1 and (np.isclose(feet[0][:, 2], lowest)).sum() >= 20


def test_what_is_no_body_about_an_axis_is_still_as_wide_and_high(decoded: Decoded) -> None:
    ring = trimesh.creation.annulus(0.05, 0.06, 0.1, sections=40)
    quarter = trimesh.boolean.intersection([ring, trimesh.creation.box(bounds=[(0, 0, -1), (1, 1, 1)])])
    for mesh, category in ((quarter, "bottle"), (quarter, "bowl")):
        pieces = convex_pieces(TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)), category)
        np.testing.assert_allclose(np.ptp(np.concatenate(pieces), axis=0), mesh.extents, rtol=0.05)


def test_a_rim_that_is_left_at_the_handle_alone_is_no_body(decoded: Decoded) -> None:
    mesh = decoded("mug")
    top = mesh.vertices[:, 2].max()
    body = measure(mesh, "mug")
    radius = body.outer[-3].mean()
    ring = trimesh.creation.annulus(body.inner[-3].mean(), radius, 0.02)
    towards_handle = trimesh.creation.box(bounds=[(0.72 * radius, -1, -1), (1, 1, 1)])
    spike = trimesh.boolean.intersection([ring, towards_handle])
    spike.apply_translation([*body.axis, top])
    whole = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces), spike])
    pieces = convex_pieces(TriangleMesh(np.asarray(whole.vertices), np.asarray(whole.faces)), "mug")
    assert pieces_volume(pieces) == pytest.approx(whole.volume, rel=0.03)


def test_a_vessel_whose_floor_is_thinner_than_the_first_height_stays_hollow() -> None:
    profile = np.array([(0, 0), (0.04, 0), (0.06, 0.05), (0.057, 0.05), (0.038, 0.0009), (0, 0.0009)])
    bowl = trimesh.creation.revolve(profile, sections=60)
    mesh = TriangleMesh(np.asarray(bowl.vertices), np.asarray(bowl.faces))
    pieces = convex_pieces(mesh, "bowl")
    assert pieces_volume(pieces) == pytest.approx(bowl.volume, rel=0.05)
    above_floor = np.array([(x, 0.0, z) for x in (0.0, 0.01, 0.03) for z in (0.004, 0.02, 0.045)])
    assert not inside(pieces, above_floor).any() and inside(pieces, np.array([(0.0, 0.0, 4e-4)])).all()


@pytest.mark.parametrize("seed", range(6))
def test_any_triangles_with_an_extent_give_solid_pieces(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(4, 30))
    vertices = rng.uniform(-0.05, 0.05, (count, 3))
    mesh = TriangleMesh(vertices, rng.integers(0, count, (int(rng.integers(1, 40)), 3)))
    for category in ("mug", "can"):
        pieces = convex_pieces(mesh, category)
        assert pieces and all(ConvexHull(piece).volume > 0 for piece in pieces)
