"""Kinds that no network is trained on; they appear in the test split alone."""

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
    moved,
    rounded_box,
    thing,
    tube,
    turned,
)


def letter(rng: np.random.Generator) -> Mesh:
    """A thick L, T, U or H, standing up or lying."""
    long, wide, bar = rng.uniform(0.07, 0.14), rng.uniform(0.05, 0.10), rng.uniform(0.012, 0.025)
    thick = rng.uniform(0.015, 0.04)
    upright = box((bar, long, thick))
    other = box((bar, long, thick), (wide, 0, 0))
    across = box((wide, bar, thick), (wide / 2, rng.choice((-1, 0)) * (long - bar) / 2, 0))
    mesh = thing(("any", [[upright, across], [upright, other, across]][rng.integers(2)]))
    return turned(mesh, np.pi / 2, (1, 0, 0)) if rng.random() < 0.5 else mesh


def bench(rng: np.random.Generator) -> Mesh:
    """A board on four legs: doll's furniture, a stand."""
    length, width, height = rng.uniform((0.07, 0.04, 0.03), (0.18, 0.12, 0.10))
    thick, leg = rng.uniform(0.005, 0.015), rng.uniform(0.006, 0.014)
    board = box((length, width, thick), (0, 0, height))
    places = [(x, y) for x in (-1, 1) for y in (-1, 1)]
    legs = [
        box((leg, leg, height), (x * (length - leg) / 2, y * (width - leg) / 2, height / 2))
        for x, y in places
    ]
    return thing((("wood", "any")[rng.integers(2)], [board, *legs]))


def spoon(rng: np.random.Generator) -> Mesh:
    """A ladle or a brush, lying: a long flat handle and a thick end."""
    length, thick = rng.uniform(0.10, 0.2), rng.uniform(0.006, 0.012)
    end = ball(rng.uniform((0.025, 0.018, 0.008), (0.045, 0.032, 0.02)), (length / 2, 0, 0))
    handle = box((length, rng.uniform(0.01, 0.02), thick))
    return thing((("metal", "wood", "any")[rng.integers(3)], [handle, end]))


def scissors(rng: np.random.Generator) -> Mesh:
    """Scissors, a little open, lying."""
    blade, ring_radius = rng.uniform(0.06, 0.11), rng.uniform(0.016, 0.026)
    opening = rng.uniform(0.1, 0.5)
    blades, rings = [], []
    for s in (-1, 1):
        outline = np.array([[-0.07, -0.006], [-0.07, 0.006], [blade, 0.001], [0.6 * blade, -0.007]])
        flat = hull(np.column_stack([np.tile(outline, (2, 1)), np.repeat([0.004, 0.008], 4)]))
        blades.append(turned(flat, s * opening))
        circle = np.linspace(0, 2 * np.pi, 20)
        path = np.stack(
            [
                -0.085 + 1.3 * ring_radius * np.cos(circle),
                s * 0.014 + ring_radius * np.sin(circle),
                0 * circle + 0.006,
            ],
            axis=1,
        )
        rings.append(turned(tube(path, 0.0045), s * opening))
    return thing(("metal", blades), ("plastic", rings))


def teapot(rng: np.random.Generator) -> Mesh:
    """A teapot or a kettle: a round body with a lid, a spout and a handle."""
    r, squat = rng.uniform(0.055, 0.09), rng.uniform(0.75, 1.1)
    t = np.linspace(0.25, np.pi - 0.2, 12)
    profile = np.column_stack([r * np.sin(t), r * squat * (np.cos(0.25) - np.cos(t))])
    top = float(profile[-1, 1])
    body = lathe([(0, 0), *profile, (0, top)], 28)
    lid = [lathe([(0, top), (0.45 * r, top), (0.35 * r, top + 0.012), (0, top + 0.015)], 24)]
    lid.append(ball(0.012, (0, 0, top + 0.024), 1))
    s = np.linspace(0, 1, 10)
    spout = tube(
        np.stack([-0.85 * r - 0.7 * r * s, 0 * s, top * (0.35 + 0.6 * s**1.5)], axis=1), 0.018 - 0.009 * s, 10
    )
    arc = np.linspace(-np.pi / 2, np.pi / 2, 12)
    side = np.stack([0.88 * r + 0.55 * r * np.cos(arc), 0 * arc, top * (0.5 + 0.3 * np.sin(arc))], axis=1)
    over = np.stack([0.8 * r * np.sin(arc), 0 * arc, top + 0.9 * r * np.cos(arc) - 0.005], axis=1)
    handle = tube(over if rng.random() < 0.3 else side, rng.uniform(0.005, 0.009))
    return thing(
        (("ceramic", "metal")[rng.integers(2)], [body, *lid, spout]),
        (("black", "ceramic")[rng.integers(2)], [handle]),
    )


def shoe(rng: np.random.Generator) -> Mesh:
    """A shoe or a slipper: a sole, a round toe and an open shaft."""
    length, width = rng.uniform(0.14, 0.29), rng.uniform(0.07, 0.1)
    sole = ball((length / 2, width / 2, 0.02), (0, 0, 0.012))
    sole.vertices[:, 2] = np.clip(sole.vertices[:, 2], 0, 0.022)
    toe = ball((0.3 * length, 0.45 * width, 0.045), (0.2 * length, 0, 0.022))
    toe.vertices[:, 2] = np.maximum(toe.vertices[:, 2], 0.015)
    outer, inner = [(0.46, 0), (0.4, 0.075)], [(0.36, 0.075), (0.4, 0), (0.46, 0)]
    shaft = lathe([(across * width, z) for across, z in (*outer, *inner)], 24)
    shaft.apply_scale((0.26 * length / (0.45 * width), 1, rng.uniform(0.8, 1.6)))
    upper = moved(shaft, -0.2 * length, 0, 0.015)
    return thing(
        (("rubber", "white")[rng.integers(2)], [sole]),
        (("fabric", "black", "any")[rng.integers(3)], [toe, upper]),
    )


def hair_dryer(rng: np.random.Generator) -> Mesh:
    """A hair dryer, lying on its side or standing on its motor."""
    radius, length = rng.uniform(0.032, 0.045), rng.uniform(0.1, 0.16)
    barrel = lathe([(0, 0), (radius, 0.01), (radius, 0.4 * length), (0.65 * radius, length), (0, length)], 24)
    nozzle = moved(box((0.075, 0.015, 0.045)), 0, 0, length + 0.015)
    grip = between((0.5 * radius, 0, 0.3 * length), (0.5 * radius + 0.12, 0, 0.22 * length), 0.018, 12)
    parts = [barrel, nozzle, grip]
    if rng.random() < 0.6:
        for part in parts:
            turned(part, np.pi / 2, (1, 0, 0))
    return thing((("black", "plastic")[rng.integers(2)], [barrel, grip]), ("black", [nozzle]))


def stapler(rng: np.random.Generator) -> Mesh:
    """A stapler: two arms that meet in a hinge."""
    length, width = rng.uniform(0.09, 0.17), rng.uniform(0.025, 0.04)
    base = rounded_box((length, width, 0.012), 0.01, (0, 0, 0.006))
    arm = turned(rounded_box((0.95 * length, 0.8 * width, 0.022), 0.008), -rng.uniform(0.08, 0.25), (0, 1, 0))
    moved(arm, -0.02 * length, 0, 0.035)
    hinge = cylinder(0.014, width, (-0.42 * length, 0, 0.02), "y", 12)
    return thing((("black", "plastic")[rng.integers(2)], [base, arm]), ("metal", [hinge]))


def padlock(rng: np.random.Generator) -> Mesh:
    """A padlock, standing or lying."""
    x, y, z = rng.uniform((0.014, 0.035, 0.03), (0.025, 0.065, 0.055))
    arc = np.linspace(0, np.pi, 14)
    bow = np.stack([0 * arc, 0.33 * y * np.cos(arc), z + 0.35 * y + 0.3 * y * np.sin(arc)], axis=1)
    bow = np.concatenate([[[0, 0.33 * y, z - 0.003]], bow, [[0, -0.33 * y, z - 0.003]]])
    parts = [rounded_box((x, y, z), 0.005, (0, 0, z / 2)), tube(bow, 0.0045)]
    if rng.random() < 0.5:
        for part in parts:
            turned(part, np.pi / 2, (0, 1, 0))
    return thing((("metal", "plastic")[rng.integers(2)], parts[:1]), ("metal", parts[1:]))


def toy_plane(rng: np.random.Generator) -> Mesh:
    """A toy plane: fuselage, wings, tail, propeller."""
    length, span, radius = rng.uniform((0.14, 0.14, 0.014), (0.26, 0.30, 0.026))
    hull_ = between((-0.5 * length, 0, 1.8 * radius), (0.35 * length, 0, 1.8 * radius), radius, 14)
    wings = [rounded_box((0.22 * length, span, 0.008), 0.01, (0.05 * length, 0, 1.6 * radius))]
    wings.append(rounded_box((0.12 * length, 0.35 * span, 0.006), 0.008, (-0.48 * length, 0, 1.9 * radius)))
    wings.append(box((0.1 * length, 0.006, 0.16 * length), (-0.48 * length, 0, 1.9 * radius + 0.08 * length)))
    wheels = [
        cylinder(0.5 * radius, 0.006, (0.1 * length, s * 0.2 * span, 0.5 * radius), "y", 12) for s in (-1, 1)
    ]
    blade = box((0.004, 0.16 * length, 0.012), (0.35 * length + radius, 0, 1.8 * radius))
    return thing(("plastic", [hull_]), ("any", wings), ("black", [*wheels, blade]))


def watering_can(rng: np.random.Generator) -> Mesh:
    """A watering can: a tub with a long spout and a bow."""
    r, height = rng.uniform(0.05, 0.075), rng.uniform(0.09, 0.13)
    tub = lathe([(0, 0), (r, 0), (0.85 * r, height), (0, height)], 28)
    s = np.linspace(0, 1, 8)
    spout = tube(
        np.stack([-0.8 * r - 1.7 * r * s, 0 * s, 0.03 + 1.1 * height * s], axis=1), 0.014 - 0.007 * s, 8
    )
    arc = np.linspace(-0.4, np.pi - 0.6, 14)
    bow = np.stack([0.2 * r + r * np.cos(arc), 0 * arc, 0.8 * height + 0.9 * r * np.sin(arc)], axis=1)
    return thing((("metal", "plastic")[rng.integers(2)], [tub, spout, tube(bow, 0.005)]))


KINDS = (
    letter, bench, spoon, scissors, teapot, shoe, hair_dryer, stapler, padlock, toy_plane, watering_can,
)  # fmt: skip
