"""Decomposition of watertight meshes: convex bodies, slices, wedges, and the cache."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from sim_assets.objects.convex import cad_mesh
from sim_assets.objects.convex.cad_mesh import cache_folder, cad_pieces


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def volume(pieces):
    return sum(ConvexHull(piece).volume for piece in pieces)


def test_cache_folder_follows_the_environment(tmp_path, monkeypatch):
    assert cache_folder() == tmp_path / "nodeslam"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/someone")
    assert str(cache_folder()) == "/home/someone/.cache/nodeslam"


def test_a_convex_closed_body_is_one_piece():
    (piece,) = cad_pieces(trimesh.creation.cylinder(0.03, 0.1, sections=24), "can", "tin")
    assert ConvexHull(piece).volume == pytest.approx(12 * 0.03**2 * np.sin(np.pi / 12) * 0.1)


def test_a_closed_body_with_a_waist_is_cut_into_slices():
    profile = np.array([(0, 0), (0.04, 0), (0.015, 0.06), (0.04, 0.12), (0, 0.12)])
    waisted = trimesh.creation.revolve(profile, sections=32)
    pieces = cad_pieces(waisted, "bottle", "waist")
    assert len(pieces) == cad_mesh.SLICES == 12
    assert volume(pieces) == pytest.approx(waisted.volume, rel=0.02)


def test_wedges_tile_the_circle_with_the_first_about_x():
    wedges = cad_mesh._wedges(np.array([(-0.05, -0.05, 0.0), (0.05, 0.05, 0.1)]), 16)
    assert len(wedges) == 16
    for k, wedge in enumerate(wedges):
        azimuth = np.arctan2(*wedge.vertices[np.hypot(*wedge.vertices[:, :2].T) > 1e-6].mean(axis=0)[1::-1])
        assert np.angle(np.exp(1j * (azimuth - 2 * np.pi * k / 16))) == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(wedge.bounds[:, 2], (-0.01, 0.11))


def test_results_are_cached_by_mesh_and_category(monkeypatch):
    calls = []

    def decompose(mesh, category):
        calls.append(category)
        return [np.arange(12.0).reshape(4, 3), np.arange(15.0).reshape(5, 3) ** 2]

    monkeypatch.setattr(cad_mesh, "_decompose", decompose)
    small, large = (trimesh.creation.box((size, 0.05, 0.05)) for size in (0.05, 0.06))
    first = cad_pieces(small, "can", "a")
    again = cad_pieces(small, "can", "b")
    assert calls == ["can"]
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    cad_pieces(small, "bottle", "a")
    cad_pieces(large, "can", "a")
    assert calls == ["can", "bottle", "can"]
    monkeypatch.setattr(cad_mesh, "VERSION", "test")
    cad_pieces(small, "can", "a")
    assert len(calls) == 4
    assert len(list(cache_folder().glob("convex_*.npz"))) == 4 and not list(cache_folder().glob("*.tmp"))


def test_without_a_home_folder_the_cache_is_among_the_temporary_files(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert cad_mesh.cache_folder().is_relative_to(tmp_path)
