"""Kitchens: pots and pans, pitchers, boards, knives, fruit and bread, baskets."""

from __future__ import annotations

import numpy as np

from sim_assets.datasets.distractors.shapes import (
    Mesh,
    ball,
    between,
    box,
    cylinder,
    hull,
    lathe,
    loft,
    moved,
    rounded_box,
    thing,
    tube,
    turned,
)


def _open_vessel(radius: float, height: float, base: float, wall: float = 0.003) -> Mesh:
    inner = [(radius - wall, height), (base - wall, wall), (0, wall)]
    return lathe([(0, 0), (base, 0), (radius, height), *inner], 36)


def pan(rng: np.random.Generator) -> Mesh:
    """A pan with a long handle."""
    radius, height = rng.uniform(0.07, 0.13), rng.uniform(0.03, 0.08)
    body = _open_vessel(radius, height, radius * rng.uniform(0.75, 0.98))
    length = min(rng.uniform(0.12, 0.2), 0.43 - 2 * radius)
    end = (radius + length, 0, height + rng.uniform(-0.01, 0.03))
    grip = between((radius - 0.003, 0, 0.75 * height), end, rng.uniform(0.007, 0.012))
    return thing(
        (("metal", "black", "plastic")[rng.integers(3)], [body]), (("black", "wood")[rng.integers(2)], [grip])
    )


def pot(rng: np.random.Generator) -> Mesh:
    """A pot with two lugs, with its lid or without."""
    radius, height = rng.uniform(0.08, 0.13), rng.uniform(0.08, 0.16)
    body = _open_vessel(radius, height, 0.97 * radius)
    arc = np.linspace(-np.pi / 2, np.pi / 2, 10)
    lugs = []
    for s in (-1, 1):
        path = np.stack(
            [s * (radius + 0.03 * np.cos(arc)), 0.035 * np.sin(arc), 0 * arc + 0.85 * height], axis=1
        )
        lugs.append(tube(path, 0.005))
    parts = [body, *lugs]
    if rng.random() < 0.5:
        rise = rng.uniform(0.005, 0.03)
        parts.append(
            moved(lathe([(0, 0), (radius, 0), (0.6 * radius, 0.8 * rise), (0, rise)], 32), 0, 0, height)
        )
        parts.append(ball((0.018, 0.018, 0.012), (0, 0, height + rise + 0.012), 1))
    return thing((("metal", "plastic", "black")[rng.integers(3)], parts))


def pitcher(rng: np.random.Generator) -> Mesh:
    """A big jug with a spout and a handle over most of its height."""
    radius, height = rng.uniform(0.055, 0.085), rng.uniform(0.17, 0.27)
    body = _open_vessel(radius, height, radius * rng.uniform(0.75, 1.0))
    body.vertices[:, 0] -= np.where(
        body.vertices[:, 0] < -0.8 * radius,
        0.4 * radius * np.maximum(body.vertices[:, 2] / height - 0.8, 0) * 5,
        0,
    )
    arc = np.linspace(-np.pi / 2, np.pi / 2, 12)
    depth = rng.uniform(0.035, 0.06)
    path = np.stack(
        [radius - 0.006 + depth * np.cos(arc), 0 * arc, height * (0.52 + 0.33 * np.sin(arc))], axis=1
    )
    return thing(
        (("plastic", "ceramic", "metal")[rng.integers(3)], [body, tube(path, rng.uniform(0.006, 0.011))])
    )


def cutting_board(rng: np.random.Generator) -> Mesh:
    """A board, lying or on its edge, often with a hole's rim or a handle."""
    x, y, z = rng.uniform((0.12, 0.18, 0.008), (0.26, 0.38, 0.025))
    parts = [rounded_box((x, y, z), rng.uniform(0.005, 0.03), (0, 0, z / 2))]
    if rng.random() < 0.4 and y < 0.3:
        parts.append(rounded_box((0.05, 0.1, z), 0.02, (0, y / 2 + 0.04, z / 2)))
    if rng.random() < 0.4:  # leaning
        for part in parts:
            turned(part, 1.3, (0, 1, 0))
    return thing((("wood", "wood", "plastic", "marble")[rng.integers(4)], parts))


def knife(rng: np.random.Generator) -> Mesh:
    """A kitchen knife, a spatula or a whisk's handle: a flat blade and a grip."""
    blade, grip = rng.uniform(0.08, 0.2), rng.uniform(0.09, 0.13)
    wide = rng.uniform(0.012, 0.045)
    outline = np.array([[0, 0], [0, wide], [0.8 * blade, 0.9 * wide], [blade, 0.1 * wide], [blade, 0]])
    flat = hull(np.column_stack([np.tile(outline, (2, 1)), np.repeat([0.006, 0.009], 5)]))
    handle = rounded_box((grip, 0.022, 0.016), 0.006, (-grip / 2, wide / 2, 0.008))
    return thing(("metal", [flat]), (("black", "wood", "plastic")[rng.integers(3)], [handle]))


def fruit(rng: np.random.Generator) -> Mesh:
    """One to three apples, pears, oranges or lemons."""
    parts, stems, reach = [], [], 0.0
    kind = rng.integers(4)
    for _ in range(rng.integers(1, 4)):
        r = rng.uniform(0.026, 0.046)
        if kind == 0:
            t = np.linspace(0, np.pi, 15)
            one = lathe(
                np.column_stack(
                    [r * np.sin(t), r * (1 - 0.85 * np.cos(t) - 0.18 * np.exp(-((t - np.pi) ** 2) * 6))]
                ),
                18,
            )
        elif kind == 1:
            t = np.linspace(0, np.pi, 15)
            one = lathe(
                np.column_stack([r * np.sin(t) * (1 - 0.45 * (t / np.pi) ** 2), 1.25 * r * (1 - np.cos(t))]),
                18,
            )
        else:
            one = ball((r, r, r) if kind == 2 else (1.3 * r, 0.9 * r, 0.9 * r))
            moved(one, 0, 0, -one.bounds[0, 2])
        height = one.bounds[1, 2]
        moved(one, reach + (one.extents[0] / 2 if reach else 0.0), rng.normal(0, 0.01))
        if kind < 2:
            x, y = one.bounds.mean(axis=0)[:2]
            stems.append(between((x, y, height - 0.006), (x + 0.004, y, height + 0.008), 0.0015, 5))
        reach = float(one.bounds[1, 0])
        parts.append(one)
    return thing(("fruit", parts), *([("wood", stems)] if stems else []))


def bread(rng: np.random.Generator) -> Mesh:
    """A loaf, a roll or a slice."""
    x, y, z = rng.uniform((0.05, 0.04, 0.03), (0.15, 0.06, 0.055))
    loaf = ball((x, y, z))
    loaf.vertices[:, 2] = np.maximum(loaf.vertices[:, 2], -0.4 * z)
    if rng.random() < 0.3:
        loaf = turned(rounded_box((0.012, 0.1, 0.1), 0.004), rng.uniform(0.2, 1.57), (0, 1, 0))
    return thing(("bread", [loaf]))


def basket(rng: np.random.Generator) -> Mesh:
    """A square basket that widens upwards, or a round one with a bow; a round one without could be a bowl."""
    radius, height = rng.uniform(0.08, 0.15), rng.uniform(0.06, 0.16)
    around = 36 if rng.random() < 0.4 else 4
    wall, base = 0.006, radius * rng.uniform(0.6, 0.95)
    body = lathe(
        [(0, 0), (base, 0), (radius, height), (radius - wall, height), (base - wall, wall), (0, wall)], around
    )
    parts = [body]
    if around > 4 or rng.random() < 0.3:
        arc = np.linspace(0, np.pi, 18)
        bow = np.stack([0.95 * radius * np.cos(arc), 0 * arc, height + 0.9 * radius * np.sin(arc)], axis=1)
        parts.append(tube(bow, 0.006))
    return thing((("wicker", "wicker", "plastic", "metal")[rng.integers(4)], parts))


def tray(rng: np.random.Generator) -> Mesh:
    """A serving tray or a baking tin with a slanted rim."""
    x, y, z = rng.uniform((0.14, 0.2, 0.012), (0.28, 0.42, 0.05))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    wide, low = corners * (x, y), corners * (0.93 * x, 0.95 * y)
    rim, floor = corners * (x - 0.008, y - 0.008), corners * (0.93 * x - 0.008, 0.95 * y - 0.008)
    rings = [(low, 0), (wide, z), (rim, z), (floor, 0.003)]
    body = loft(np.stack([np.column_stack([ring, np.full(4, h)]) for ring, h in rings]))
    return thing((("metal", "wood", "plastic", "black")[rng.integers(4)], [body]))


def sponge(rng: np.random.Generator) -> Mesh:
    """A sponge, a bar of soap or a block of foam, in two layers."""
    x, y, z = rng.uniform((0.05, 0.07, 0.02), (0.09, 0.14, 0.05))
    layers = [
        rounded_box((x, y, h), 0.008, (0, 0, at)) for h, at in ((0.7 * z, 0.35 * z), (0.3 * z, 0.85 * z))
    ]
    return thing(("foam", layers[:1]), ("fabric", layers[1:]))


def candle_holder(rng: np.random.Generator) -> Mesh:
    """A holder with two to five thin candles."""
    parts, candles = [box((0.03, 0.2, 0.012), (0, 0, 0.006))], []
    for at in np.linspace(-0.085, 0.085, rng.integers(2, 6)):
        parts.append(cylinder(0.004, 0.05, (0, at, 0.035), around=8))
        candles.append(cylinder(0.01, 0.12, (0, at, 0.12), around=12))
    return thing(("metal", parts), ("white", candles))


KINDS = (
    pan, pan, pot, pot, pitcher, pitcher, cutting_board, knife, fruit, fruit, fruit, bread, basket, basket,
    tray, sponge, candle_holder,
)  # fmt: skip
