"""Packages: cartons that stand, lie, lean and pile up, cartons of juice, tins with corners, pouches."""

from __future__ import annotations

import numpy as np

from sim_assets.datasets.distractors.shapes import (
    Mesh,
    box,
    hull,
    lathe,
    loft,
    moved,
    rounded_box,
    thing,
    turned,
)


def carton_size(rng: np.random.Generator) -> np.ndarray:
    """Return depth, width and height of a carton of food or household goods in [m]."""
    if rng.random() < 0.6:  # cereals, crackers, detergents
        return rng.uniform((0.035, 0.11, 0.15), (0.085, 0.24, 0.32))
    return rng.uniform((0.03, 0.05, 0.07), (0.09, 0.15, 0.20))  # tea, sugar, spaghetti, medicine


def carton(rng: np.random.Generator) -> Mesh:
    """A standing carton."""
    return thing(("print", [box(carton_size(rng))]))


def lying_carton(rng: np.random.Generator) -> Mesh:
    """A carton on its front or on its side."""
    mesh = box(carton_size(rng))
    axis = (0, 1, 0) if rng.random() < 0.7 else (1, 0, 0)
    return thing(("print", [turned(mesh, np.pi / 2 * rng.choice((-1, 1)), axis)]))


def leaning_cartons(rng: np.random.Generator) -> Mesh:
    """A carton that leans against another."""
    first, second = carton_size(rng), carton_size(rng)
    tilt = rng.uniform(0.12, 0.5)
    leaning = moved(box(second), second[0] / 2, 0, second[2] / 2)
    turned(leaning, -tilt, (0, 1, 0))  # about the edge on the ground, its top towards -x
    standing_one = moved(box(first), 0, 0, first[2] / 2)
    reach = min(first[2], second[2] * np.cos(tilt))
    moved(leaning, first[0] / 2 + reach * np.tan(tilt), rng.uniform(-0.3, 0.3) * first[1])
    return thing(("print", [standing_one]), ("print", [leaning]))


def pile(rng: np.random.Generator) -> Mesh:
    """Two or three lying cartons on each other, each turned differently."""
    parts, height = [], 0.0
    for level in range(rng.integers(2, 4)):
        depth, width, long = carton_size(rng)
        part = box((long, width, depth), yaw=rng.normal(0, 0.5) + np.pi / 2 * rng.integers(2))
        shift = rng.normal(0, 0.015, 2)
        parts.append(moved(part, shift[0], shift[1], height + depth / 2))
        height += depth
        if level == 0 and rng.random() < 0.3:  # one that stands on the first
            small = rng.uniform((0.03, 0.05, 0.05), (0.07, 0.09, 0.16))
            parts.append(box(small, (0, 0, height + small[2] / 2), rng.uniform(-1, 1)))
            break
    return thing(("print", parts[::2]), ("print", parts[1::2]))


def open_carton(rng: np.random.Generator) -> Mesh:
    """A carton without its top, with some of its flaps half open."""
    x, y, z = carton_size(rng) if rng.random() < 0.6 else rng.uniform((0.1, 0.12, 0.06), (0.26, 0.3, 0.2))
    wall = 0.003
    sides = [box((wall, y, z), (s * (x - wall) / 2, 0, z / 2)) for s in (-1, 1)]
    sides += [box((x, wall, z), (0, s * (y - wall) / 2, z / 2)) for s in (-1, 1)]
    floor = box((x, y, wall), (0, 0, wall / 2))
    flaps = []
    for s in (-1, 1):
        if rng.random() < 0.8:
            flap = moved(box((0.45 * min(x, 0.16), 0.98 * y, wall)), s * 0.225 * min(x, 0.16))
            turned(flap, -s * rng.uniform(-0.9, 1.2), (0, 1, 0))
            flaps.append(moved(flap, s * x / 2, 0, z))
        if rng.random() < 0.8:
            flap = moved(box((0.98 * x, 0.3 * min(y, 0.2), wall)), 0, s * 0.15 * min(y, 0.2))
            turned(flap, s * rng.uniform(-0.9, 1.2), (1, 0, 0))
            flaps.append(moved(flap, 0, s * y / 2, z))
    return thing(("print" if rng.random() < 0.5 else "card", sides), ("card", [floor, *flaps]))


def brick_carton(rng: np.random.Generator) -> Mesh:
    """A carton of juice or milk with a flat top and often a screw cap."""
    x, y, z = rng.uniform((0.045, 0.05, 0.10), (0.085, 0.095, 0.25))
    parts = [rounded_box((x, y, z), 0.003, (0, 0, z / 2)), box((0.004, y, 0.006), (0, 0, z + 0.002))]
    if rng.random() < 0.6:
        cap = lathe([(0, 0), (0.014, 0), (0.013, 0.014), (0, 0.014)], 16)
        return thing(("print", parts), ("plastic", [moved(cap, 0.25 * x, 0, z)]))
    return thing(("print", parts))


def gable_carton(rng: np.random.Generator) -> Mesh:
    """A carton of milk with a roof, a fin on the ridge and sometimes a cap on the slope."""
    side, body = rng.uniform(0.055, 0.098), rng.uniform(0.08, 0.20)
    rise, fin, half = rng.uniform(0.35, 0.6) * side, rng.uniform(0.012, 0.02), side / 2
    square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    low = np.column_stack([np.tile(square, (2, 1)), np.repeat([0, body], 4)])
    ridge = np.array([[0.001, -half, body + rise], [-0.001, half, body + rise]])
    parts = [hull(np.concatenate([low, ridge])), box((0.003, side, fin), (0, 0, body + rise + fin / 2))]
    if rng.random() < 0.6:
        cap = turned(
            lathe([(0, 0), (0.015, 0), (0.014, 0.014), (0, 0.014)], 16), np.arctan2(rise, half), (0, 1, 0)
        )
        return thing(("print", parts), ("plastic", [moved(cap, half / 2, 0, body + rise / 2)]))
    return thing(("print", parts))


def square_tin(rng: np.random.Generator) -> Mesh:
    """A tin of meat, tea or biscuits with rounded edges and a lid or a seam."""
    x, y, z = rng.uniform((0.045, 0.07, 0.03), (0.13, 0.2, 0.15))
    radius = min(x, y) * rng.uniform(0.12, 0.3)
    parts = [rounded_box((x, y, z), radius, (0, 0, z / 2))]
    edge = rng.uniform(0.002, 0.015)
    lid = rounded_box((x + 0.002, y + 0.002, edge), radius, (0, 0, z - edge / 2 + 0.001))
    return thing(("print", parts), ("metal", [lid]))


def egg_box(rng: np.random.Generator) -> Mesh:
    """A box of card for 6 to 10 eggs, with bumps below and a lid that narrows upwards."""
    rows, pitch = int(rng.integers(3, 6)), rng.uniform(0.046, 0.052)
    x, y, z = 2.1 * pitch, rows * pitch, rng.uniform(0.055, 0.07)
    bumps = []
    for i in (-0.5, 0.5):
        for j in range(rows):
            bump = lathe([(0, 0), (0.3 * pitch, 0), (0.5 * pitch, 0.5 * z), (0, 0.5 * z)], 10)
            bumps.append(moved(bump, i * pitch, (j - (rows - 1) / 2) * pitch))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (x / 2, y / 2)
    lid = [np.column_stack([s * corners, np.full(4, h)]) for s, h in ((1, 0.5 * z), (0.85, z))]
    return thing(("card", bumps), (("print", "card")[rng.integers(2)], [hull(np.concatenate(lid))]))


def tissue_box(rng: np.random.Generator) -> Mesh:
    """A box of tissues, one of them half out."""
    x, y, z = rng.uniform((0.10, 0.11, 0.05), (0.13, 0.25, 0.13))
    points = np.column_stack([rng.normal(0, 0.018, (14, 2)), rng.uniform(0, 0.07, 14) + z])
    points[:, :2] *= 1.4 - (points[:, 2:] - z) / 0.07
    return thing(("print", [box((x, y, z), (0, 0, z / 2))]), ("white", [hull(points)]))


def pouch(rng: np.random.Generator) -> Mesh:
    """A filled bag with sealed ends, lying or standing: coffee, crisps, flour."""
    x, y, z = rng.uniform((0.04, 0.08, 0.10), (0.09, 0.16, 0.26))
    at = np.linspace(-1, 1, 11)
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    full = np.maximum(np.sqrt(1 - np.abs(at) ** rng.uniform(2, 6)), 0.03)
    dents = 1 + rng.normal(0, 0.05, (11, 20))
    across = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.8
    ring_x = x / 2 * full[:, None] * across * dents
    ring_y = y / 2 * (0.93 + 0.07 * np.abs(at))[:, None] * np.sin(angle)
    mesh = loft(np.stack([ring_x, ring_y, np.broadcast_to(z / 2 * at[:, None], ring_x.shape)], axis=-1))
    return thing(("print", [turned(mesh, np.pi / 2, (0, 1, 0)) if rng.random() < 0.5 else mesh]))


KINDS = (
    carton, carton, carton, carton, lying_carton, lying_carton, leaning_cartons, pile, pile, open_carton,
    open_carton, brick_carton, brick_carton, gable_carton, square_tin, square_tin, egg_box, tissue_box, pouch,
    pouch,
)  # fmt: skip
