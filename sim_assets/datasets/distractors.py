"""Distractors, objects of unknown class: parcels, balls, books, tools, crates, plates, fruit, toys.

Letters, benches and spoons are held out for testing.
"""

from __future__ import annotations

from typing import Literal, cast

import numpy as np
import trimesh
from trimesh import creation

HELD_OUT_SHARE = 0.4


def random_distractor(rng: np.random.Generator, split: Literal["train", "test"] = "train") -> trimesh.Trimesh:
    """Return a mesh in [m], z up, resting on z = 0; its parts may overlap (it is for rendering only).

    In the test split, a share HELD_OUT_SHARE is of kinds absent from the training split.
    """
    kinds = _HELD_OUT if split == "test" and rng.random() < HELD_OUT_SHARE else _KINDS
    kind = kinds[rng.integers(len(kinds))]
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


def figure(rng: np.random.Generator) -> trimesh.Trimesh:
    """A toy figure: random rounded limbs about a body."""
    parts = [creation.icosphere(subdivisions=2, radius=rng.uniform(0.015, 0.035))]
    for _ in range(rng.integers(2, 7)):
        limb = creation.capsule(
            height=rng.uniform(0.02, 0.07), radius=rng.uniform(0.006, 0.014), count=(8, 8)
        )
        limb.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        limb.apply_translation(rng.normal(0, 0.012, 3))
        parts.append(limb)
    return _joined(parts)


def blocks(rng: np.random.Generator) -> trimesh.Trimesh:
    """Building blocks joined side by side and on top of each other."""
    side = rng.uniform(0.018, 0.032)
    cells = {(0, 0, 0)}
    for _ in range(rng.integers(1, 7)):
        x, y, z = list(cells)[rng.integers(len(cells))]
        step = np.eye(3, dtype=int)[rng.integers(3)] * rng.choice((-1, 1))
        cells.add((x + int(step[0]), y + int(step[1]), max(0, z + int(step[2]))))
    return _joined([_box((side, side, side), (side * x, side * y, side * z)) for x, y, z in sorted(cells)])


def slab(rng: np.random.Generator) -> trimesh.Trimesh:
    """A flat box: a phone, a box of chocolates, a tile; sometimes an upright book."""
    x, y, z = rng.uniform((0.05, 0.08, 0.006), (0.12, 0.20, 0.03)).tolist()
    return _box((x, y, z) if rng.random() < 0.7 else (x, z, y))


def candlestick(rng: np.random.Generator) -> trimesh.Trimesh:
    """A turned foot, a thin stem, and a plate or a ball on top: a chess piece, a lamp, a trophy."""
    foot, stem = rng.uniform(0.025, 0.055), rng.uniform(0.004, 0.010)
    height, top = rng.uniform(0.08, 0.22), rng.uniform(0.012, 0.05)
    thick = rng.uniform(0.006, 0.025)
    profile = [
        (0, 0), (foot, 0), (foot, 0.006), (stem, 0.03), (stem, height - thick),
        (top, height - thick), (top * rng.uniform(0.4, 1.0), height), (0, height),
    ]  # fmt: skip
    return creation.revolve(np.array(profile), sections=32)


def letter(rng: np.random.Generator) -> trimesh.Trimesh:
    """A thick L, T, U or H, standing up or lying."""
    long, wide, bar = rng.uniform(0.07, 0.14), rng.uniform(0.05, 0.10), rng.uniform(0.012, 0.025)
    thick = rng.uniform(0.015, 0.04)
    upright = _box((bar, long, thick))
    other = _box((bar, long, thick), (wide, 0, 0))
    across = _box((wide, bar, thick), (wide / 2, rng.choice((-1, 0)) * (long - bar) / 2, 0))
    mesh = _joined([[upright, across], [upright, other, across]][rng.integers(2)])
    if rng.random() < 0.5:
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    return mesh


def bench(rng: np.random.Generator) -> trimesh.Trimesh:
    """A board on two or four legs: doll's furniture, a stand."""
    length, width, height = rng.uniform((0.07, 0.04, 0.03), (0.18, 0.12, 0.10))
    thick, leg = rng.uniform(0.005, 0.015), rng.uniform(0.006, 0.014)
    board = _box((length, width, thick), (0, 0, height))
    places = [(x, y) for x in (-1, 1) for y in (-1, 1)]
    legs = [
        _box((leg, leg, height), (x * (length - leg) / 2, y * (width - leg) / 2, height / 2))
        for x, y in places
    ]
    return _joined([board, *legs])


def spoon(rng: np.random.Generator) -> trimesh.Trimesh:
    """A ladle or a brush, lying: a long flat handle and a thick end."""
    length, thick = rng.uniform(0.10, 0.2), rng.uniform(0.006, 0.012)
    end = creation.icosphere(subdivisions=2, radius=1.0)
    end.apply_scale(rng.uniform((0.025, 0.018, 0.008), (0.045, 0.032, 0.02)))
    end.apply_translation((length / 2, 0, 0))
    return _joined([_box((length, rng.uniform(0.01, 0.02), thick)), end])


def random_parts(rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a pebble, a prism or a union of random parts; for training only."""
    draw = rng.random()
    if draw < 0.25:
        mesh = trimesh.convex.convex_hull(rng.normal(size=(rng.integers(6, 20), 3)))
        mesh.apply_scale(rng.uniform(0.03, 0.10, 3) / np.ptp(mesh.bounds, axis=0))
    elif draw < 0.45:  # vertical edges distinguish prisms from cans
        radius, height = rng.uniform(0.02, 0.05), rng.uniform(0.05, 0.22)
        mesh = creation.cylinder(radius=radius, height=height, sections=int(rng.integers(3, 7)))
        mesh.apply_scale((1, rng.uniform(0.5, 1.0), 1))
    else:
        mesh = _joined([_odd_part(rng) for _ in range(rng.integers(2, 6))])
    mesh.apply_translation((*-mesh.bounds[:, :2].mean(axis=0), -mesh.bounds[0, 2]))
    return mesh


def _odd_part(rng: np.random.Generator) -> trimesh.Trimesh:
    """A randomly rotated box, cylinder, cone or ellipsoid near the origin."""
    size = rng.uniform(0.015, 0.09, 3)
    kind = rng.integers(4)
    if kind == 0:
        part = _box(tuple(size))
    elif kind == 1:
        part = creation.cylinder(radius=size[0] / 3, height=1.5 * size[1], sections=20)
    elif kind == 2:
        part = creation.cone(radius=size[0] / 2, height=size[1], sections=20)
    else:
        part = creation.icosphere(subdivisions=2, radius=0.5)
        part.apply_scale(size)
    part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    part.apply_translation(rng.normal(0, 0.02, 3))
    return part


_KINDS = (
    parcel, parcel, ball, books, hammer, screwdriver, crate, crate, plate, banana, pyramid, ring,
    figure, figure, blocks, slab, candlestick,
)  # fmt: skip
_HELD_OUT = (letter, bench, spoon)
