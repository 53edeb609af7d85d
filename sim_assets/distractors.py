"""Things of no class that lie about on tables: parcels, balls, books, tools, open crates, plates, fruit."""

from __future__ import annotations

from typing import cast

import numpy as np
import trimesh
from trimesh import creation


def random_distractor(rng: np.random.Generator) -> trimesh.Trimesh:
    """A mesh in [m], z up, resting on z = 0. Parts may overlap: it is made to be looked at."""
    kind = _KINDS[rng.integers(len(_KINDS))]
    mesh = kind(rng)
    mesh.apply_translation((*-mesh.bounds[:, :2].mean(axis=0), -mesh.bounds[0, 2]))
    return mesh


def _box(size: tuple[float, float, float], center: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    return creation.box(size, transform=trimesh.transformations.translation_matrix(center))


def _joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return cast(trimesh.Trimesh, trimesh.util.concatenate(parts))


def parcel(rng: np.random.Generator) -> trimesh.Trimesh:
    """A closed box."""
    return _box(tuple(rng.uniform((0.04, 0.04, 0.03), (0.18, 0.14, 0.16))))


def ball(rng: np.random.Generator) -> trimesh.Trimesh:
    """A ball, an egg or an apple."""
    mesh = creation.icosphere(subdivisions=3, radius=rng.uniform(0.02, 0.055))
    mesh.apply_scale((1, 1, rng.uniform(0.75, 1.2)))
    return mesh


def books(rng: np.random.Generator) -> trimesh.Trimesh:
    """One to four books in an untidy pile."""
    parts, height = [], 0.0
    for _ in range(rng.integers(1, 5)):
        size = rng.uniform((0.11, 0.15, 0.008), (0.17, 0.24, 0.035))
        book = _box(tuple(size))
        book.apply_transform(trimesh.transformations.rotation_matrix(rng.normal(0, 0.15), (0, 0, 1)))
        book.apply_translation((*rng.normal(0, 0.008, 2), height + size[2] / 2))
        height += size[2]
        parts.append(book)
    return _joined(parts)


def hammer(rng: np.random.Generator) -> trimesh.Trimesh:
    """A lying tool: a handle and a head."""
    length, radius = rng.uniform(0.16, 0.28), rng.uniform(0.008, 0.016)
    handle = creation.capsule(height=length, radius=radius, count=(10, 10))
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    width, thick = rng.uniform(0.06, 0.12), rng.uniform(0.02, 0.035)
    return _joined([handle, _box((thick, width, thick), (length, 0, thick / 2 - radius))])


def screwdriver(rng: np.random.Generator) -> trimesh.Trimesh:
    """A thick grip with a thin blade."""
    grip, blade = rng.uniform(0.08, 0.11), rng.uniform(0.08, 0.16)
    radius = rng.uniform(0.01, 0.018)
    shaft = creation.cylinder(radius=0.004, height=blade, sections=12)
    shaft.apply_translation((0, 0, grip + blade / 2))
    mesh = _joined([creation.capsule(height=grip, radius=radius, count=(12, 12)), shaft])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    return mesh


def crate(rng: np.random.Generator) -> trimesh.Trimesh:
    """An open box of four walls and a floor."""
    length, width, depth = rng.uniform((0.16, 0.14, 0.04), (0.38, 0.32, 0.12))
    wall = rng.uniform(0.004, 0.012)
    sides = [_box((wall, width, depth), (sign * (length - wall) / 2, 0, depth / 2)) for sign in (-1, 1)] + [
        _box((length, wall, depth), (0, sign * (width - wall) / 2, depth / 2)) for sign in (-1, 1)
    ]
    return _joined([*sides, _box((length, width, wall), (0, 0, wall / 2))])


def plate(rng: np.random.Generator) -> trimesh.Trimesh:
    """A flat plate or tray with a low rim."""
    radius, height = rng.uniform(0.07, 0.13), rng.uniform(0.008, 0.02)
    profile = [
        (0, 0),
        (0.6 * radius, 0),
        (radius, height),
        (radius, height + 0.003),
        (0.6 * radius, 0.003),
        (0, 0.003),
    ]
    return creation.revolve(np.array(profile), sections=48)


def banana(rng: np.random.Generator) -> trimesh.Trimesh:
    """A bent, lying fruit."""
    bend, length = rng.uniform(0.8, 1.8), rng.uniform(0.13, 0.2)
    angle = np.linspace(-bend / 2, bend / 2, 9)
    spine = np.stack([np.sin(angle), np.cos(angle) - 1, 0 * angle], axis=1) * (length / bend)
    thickness = rng.uniform(0.014, 0.019) * np.sqrt(np.cos(np.linspace(-1.35, 1.35, 9)))
    circle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    across = np.stack([np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    points = spine[:, None] + thickness[:, None, None] * (
        np.cos(circle)[:, None] * across[:, None] + np.sin(circle)[:, None] * np.array([0, 0, 1.0])
    )
    parts = [trimesh.convex.convex_hull(np.concatenate(points[i : i + 2])) for i in range(8)]
    return _joined(parts)


def pyramid(rng: np.random.Generator) -> trimesh.Trimesh:
    """A wedge, a cone or a house: the hull of a base and a smaller top."""
    base = rng.uniform(0.03, 0.09, 2)
    top = base * rng.uniform(0.0, 0.7, 2)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    low = np.column_stack([corners * base, np.zeros(4)])
    high = np.column_stack([corners * top + 1e-4, np.full(4, rng.uniform(0.04, 0.14))])
    return trimesh.convex.convex_hull(np.concatenate([low, high + rng.normal(0, 1e-4, high.shape)]))


def ring(rng: np.random.Generator) -> trimesh.Trimesh:
    """A roll of tape or a ring, lying."""
    radius = rng.uniform(0.03, 0.06)
    width, height = rng.uniform(0.006, 0.02), rng.uniform(0.01, 0.03)
    profile = [
        (radius - width, 0),
        (radius, 0),
        (radius, height),
        (radius - width, height),
        (radius - width, 0),
    ]
    return creation.revolve(np.array(profile), sections=40)


_KINDS = (parcel, parcel, ball, books, hammer, screwdriver, crate, crate, plate, banana, pyramid, ring)
