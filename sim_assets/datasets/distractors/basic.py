"""Plain shapes, tools and toys: parcels, balls, books, crates, plates, fruit, blocks, and random parts."""

from __future__ import annotations

import numpy as np
import trimesh
from trimesh import creation

from sim_assets.datasets.distractors.odd_vessels import odd_vessel
from sim_assets.datasets.distractors.shapes import (
    Mesh,
    ball,
    between,
    box,
    cylinder,
    hull,
    lathe,
    loft,
    mapped,
    standing,
    thing,
    tube,
    turned,
)


def parcel(rng: np.random.Generator) -> Mesh:
    """A closed box, printed or of card."""
    size = rng.uniform((0.04, 0.04, 0.03), (0.18, 0.14, 0.16))
    return thing(("print" if rng.random() < 0.6 else "card", [box(size)]))


def round_thing(rng: np.random.Generator) -> Mesh:
    """A ball, an egg or an apple."""
    radius = rng.uniform(0.02, 0.055)
    mesh = ball((radius, radius, radius * rng.uniform(0.75, 1.2)), detail=3)
    return thing((("plastic", "fruit", "any")[rng.integers(3)], [mesh]))


def books(rng: np.random.Generator) -> Mesh:
    """One to four books in an untidy pile."""
    covers, pages, height = [], [], 0.0
    for _ in range(rng.integers(1, 5)):
        size = rng.uniform((0.11, 0.15, 0.008), (0.17, 0.24, 0.04))
        one = book(*size)
        turn, shift = rng.normal(0, 0.15) + np.pi * rng.integers(2), rng.normal(0, 0.008, 2)
        for part in one:
            turned(part, turn).apply_translation((*shift, height))
        covers += one[:-1]
        pages.append(one[-1])
        height += size[2]
    return thing(("cover", covers), ("pages", pages))


def book(x: float, y: float, z: float) -> list[Mesh]:
    """Return two covers, a spine and the block of pages of a book that lies on z = 0."""
    thick = min(0.003, 0.25 * z)
    covers = [box((x, y, thick), (0, 0, at)) for at in (thick / 2, z - thick / 2)]
    spine = box((thick, y, z), (-(x - thick) / 2, 0, z / 2))
    return [*covers, spine, box((x - 0.006, y - 0.008, z - thick), (-0.001, 0, z / 2))]


def hammer(rng: np.random.Generator) -> Mesh:
    """A lying tool: a handle and a head."""
    length, radius = rng.uniform(0.16, 0.28), rng.uniform(0.008, 0.016)
    width, thick = rng.uniform(0.06, 0.12), rng.uniform(0.02, 0.035)
    head = box((thick, width, thick), (length, 0, thick / 2 - radius))
    return thing(
        (("wood", "rubber")[rng.integers(2)], [between((0, 0, 0), (length, 0, 0), radius)]), ("metal", [head])
    )


def screwdriver(rng: np.random.Generator) -> Mesh:
    """A thick grip with a thin blade."""
    grip, blade = rng.uniform(0.08, 0.11), rng.uniform(0.08, 0.16)
    shaft = cylinder(0.004, blade, (grip + blade / 2, 0, 0), "x", 12)
    return thing(
        ("plastic", [between((0, 0, 0), (grip, 0, 0), rng.uniform(0.01, 0.018), 12)]), ("metal", [shaft])
    )


def crate(rng: np.random.Generator) -> Mesh:
    """An open box of four walls and a floor."""
    length, width, depth = rng.uniform((0.16, 0.14, 0.04), (0.38, 0.32, 0.12))
    wall = rng.uniform(0.004, 0.012)
    sides = [box((wall, width, depth), (sign * (length - wall) / 2, 0, depth / 2)) for sign in (-1, 1)] + [
        box((length, wall, depth), (0, sign * (width - wall) / 2, depth / 2)) for sign in (-1, 1)
    ]
    surface = ("plastic", "card", "wood", "wicker")[rng.integers(4)]
    return thing((surface, [*sides, box((length, width, wall), (0, 0, wall / 2))]))


def plate(rng: np.random.Generator) -> Mesh:
    """A flat plate with a low rim."""
    return thing(("ceramic", [_plate(rng.uniform(0.07, 0.14), rng.uniform(0.008, 0.02))]))


def plates(rng: np.random.Generator) -> Mesh:
    """A stack of plates."""
    radius, height = rng.uniform(0.08, 0.14), rng.uniform(0.010, 0.022)
    stack = []
    for level in range(rng.integers(2, 6)):
        one = _plate(radius, height, around=24)
        one.apply_translation((*rng.normal(0, 0.002, 2), level * rng.uniform(0.0045, 0.009)))
        stack.append(one)
    return thing(("ceramic", stack))


def _plate(radius: float, height: float, around: int = 48) -> Mesh:
    foot = 0.6 * radius
    top = [(radius, height + 0.003), (foot, 0.003), (0, 0.003)]
    return lathe([(0, 0), (foot, 0), (radius, height), *top], around)


def banana(rng: np.random.Generator) -> Mesh:
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
    return thing(("banana", [hull(np.concatenate(points[i : i + 2])) for i in range(8)]))


def pyramid(rng: np.random.Generator) -> Mesh:
    """A wedge, a cone or a house: the hull of a base and a smaller top."""
    base = rng.uniform(0.03, 0.09, 2)
    top = base * rng.uniform(0.0, 0.7, 2)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    low = np.column_stack([corners * base, np.zeros(4)])
    high = np.column_stack([corners * top + 1e-4, np.full(4, rng.uniform(0.04, 0.14))])
    return thing(("any", [hull(np.concatenate([low, high + rng.normal(0, 1e-4, high.shape)]))]))


def ring(rng: np.random.Generator) -> Mesh:
    """A roll of tape or a ring, lying."""
    radius = rng.uniform(0.03, 0.06)
    width, height = rng.uniform(0.006, 0.025), rng.uniform(0.01, 0.05)
    inner = radius - width
    return thing(
        ("plastic", [lathe([(inner, 0), (radius, 0), (radius, height), (inner, height), (inner, 0)], 40)])
    )


def figure(rng: np.random.Generator) -> Mesh:
    """A toy figure: random rounded limbs about a body."""
    limbs = []
    for _ in range(rng.integers(2, 7)):
        radius = rng.uniform(0.006, 0.014)
        limb = between((0, 0, 0), (0, 0, rng.uniform(0.02, 0.07)), radius, 8)
        limb.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        limb.apply_translation(rng.normal(0, 0.012, 3))
        limbs.append(limb)
    return thing(("any", limbs), ("plastic", [ball(rng.uniform(0.015, 0.035))]))


def blocks(rng: np.random.Generator) -> Mesh:
    """Building blocks joined side by side and on top of each other."""
    side = rng.uniform(0.018, 0.032)
    cells = {(0, 0, 0)}
    for _ in range(rng.integers(1, 7)):
        x, y, z = list(cells)[rng.integers(len(cells))]
        step = np.eye(3, dtype=int)[rng.integers(3)] * rng.choice((-1, 1))
        cells.add((x + int(step[0]), y + int(step[1]), max(0, z + int(step[2]))))
    cubes = [box((side, side, side), (side * x, side * y, side * z)) for x, y, z in sorted(cells)]
    groups = [("plastic", cubes[i::3]) for i in range(3) if cubes[i::3]]
    return thing(*groups)


def slab(rng: np.random.Generator) -> Mesh:
    """A flat box: a box of chocolates, a tile; sometimes upright."""
    x, y, z = rng.uniform((0.05, 0.08, 0.006), (0.16, 0.24, 0.04)).tolist()
    return thing((("print", "any")[rng.integers(2)], [box((x, y, z) if rng.random() < 0.6 else (x, z, y))]))


def candlestick(rng: np.random.Generator) -> Mesh:
    """A turned foot, a thin stem, and a plate or a ball on top: a chess piece, a trophy."""
    foot, stem = rng.uniform(0.025, 0.055), rng.uniform(0.004, 0.010)
    height, top = rng.uniform(0.08, 0.22), rng.uniform(0.012, 0.05)
    thick = rng.uniform(0.006, 0.025)
    profile = [
        (0, 0), (foot, 0), (foot, 0.006), (stem, 0.03), (stem, height - thick),
        (top, height - thick), (top * rng.uniform(0.4, 1.0), height), (0, height),
    ]  # fmt: skip
    return thing((("metal", "wood", "ceramic")[rng.integers(3)], [lathe(profile, 32)]))


def random_parts(rng: np.random.Generator) -> Mesh:
    """Return a pebble, a prism, a lump, an odd vessel or a union of random parts; for training only."""
    draw = rng.random()
    if draw < 0.4:
        return odd_vessel(rng)
    draw = (draw - 0.4) / 0.6
    if draw < 0.25:
        pebble = trimesh.convex.convex_hull(rng.normal(size=(rng.integers(6, 20), 3)))
        pebble.apply_scale(rng.uniform(0.03, 0.10, 3) / np.ptp(pebble.bounds, axis=0))
        parts = [mapped(pebble)]
    elif draw < 0.45:  # vertical edges distinguish prisms from cans
        radius, height = rng.uniform(0.02, 0.05), rng.uniform(0.05, 0.26)
        prism = creation.cylinder(radius=radius, height=height, sections=int(rng.integers(3, 7)))
        prism.apply_scale((1, rng.uniform(0.5, 1.0), 1))
        parts = [mapped(prism)]
    elif draw < 0.70:
        parts = [_lump(rng)]
    else:
        parts = [_odd_part(rng) for _ in range(rng.integers(2, 6))]
    return standing(thing(*[("any", parts[i::3]) for i in range(3) if parts[i::3]]))


def _lump(rng: np.random.Generator) -> Mesh:
    """Return a closed surface through rounded sections that change in place, size and direction upwards.

    It is never round about a vertical axis: such things would be bottles or cans.
    """
    levels, around = int(rng.integers(4, 9)), 24
    height, size = rng.uniform(0.03, 0.22), rng.uniform(0.02, 0.08)
    at = np.linspace(0, 1, levels)
    lean = rng.normal(0, 0.7 * size, 2) * at[:, None]
    wander = lean + np.cumsum(rng.normal(0, 0.35 * size, (levels, 2)), axis=0)
    half = size * np.exp(np.cumsum(rng.normal(0, 0.25, (levels, 2)), axis=0)) * (1, rng.uniform(0.3, 0.75))
    half = np.clip(half, 0.3 * size, 1.6 * size)
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(0, 0.15, levels))
    angle, power = np.linspace(0, 2 * np.pi, around, endpoint=False), rng.uniform(0.3, 1.0)
    unit = np.stack([np.sign(f) * np.abs(f) ** power for f in (np.cos(angle), np.sin(angle))], axis=-1)
    rings = []
    for level in range(levels):
        c, s = np.cos(yaw[level]), np.sin(yaw[level])
        ring = (unit * half[level]) @ np.array([[c, s], [-s, c]]) + wander[level]
        rings.append(np.column_stack([ring, np.full(around, at[level] * height)]))
    lump = loft(np.stack(rings))
    if rng.random() < 0.4:
        lump.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    return mapped(lump)


def _odd_part(rng: np.random.Generator) -> Mesh:
    """A randomly rotated box, cylinder, cone, ellipsoid, open vessel or bent tube near the origin."""
    size = rng.uniform(0.015, 0.09, 3)
    kind = rng.integers(6)
    if kind == 0:
        part = box(size)
    elif kind == 1:
        part = cylinder(size[0] / 3, 1.5 * size[1])
    elif kind == 2:
        part = mapped(creation.cone(radius=size[0] / 2, height=size[1], sections=20))
    elif kind == 3:
        part = ball(size / 2)
    elif kind == 4:
        r, top, z = size[0], size[0] * rng.uniform(0.6, 1.4), size[1]
        part = lathe([(0, 0), (0.6 * r, 0), (0.6 * top, z), (0.5 * top, z), (0.5 * r, 0.004), (0, 0.004)], 24)
    else:
        angle = np.linspace(0, rng.uniform(0.5, 4.0), 10)
        arc = np.stack([size[0] * np.cos(angle), size[0] * np.sin(angle), 0.2 * size[1] * angle], axis=1)
        part = tube(arc, rng.uniform(0.003, 0.010))
    part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    part.apply_translation(rng.normal(0, 0.02, 3))
    return part


KINDS = (
    parcel, round_thing, books, hammer, screwdriver, crate, plate, plates, banana, pyramid, ring, figure,
    blocks, slab, candlestick,
)  # fmt: skip
