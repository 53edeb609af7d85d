"""Tools and toys: drills, clamps, bricks, blocks with studs, cars, cubes, dice, grippers."""

from __future__ import annotations

import numpy as np

from sim_assets.datasets.distractors.shapes import (
    Mesh,
    between,
    box,
    cylinder,
    lathe,
    moved,
    rounded_box,
    thing,
    turned,
)


def drill(rng: np.random.Generator) -> Mesh:
    """A cordless drill: body, chuck, handle, battery; standing on its battery or lying on its side."""
    length, radius, grip = rng.uniform(0.13, 0.18), rng.uniform(0.028, 0.036), rng.uniform(0.09, 0.13)
    top = 0.05 + grip + radius
    barrel = between((-0.35 * length, 0, top), (0.35 * length, 0, top), radius, 16)
    chuck = turned(
        lathe([(0, 0), (0.022, 0), (0.02, 0.035), (0.008, 0.05), (0, 0.05)], 16), np.pi / 2, (0, 1, 0)
    )
    moved(chuck, 0.35 * length + 0.8 * radius, 0, top)
    bit = cylinder(0.003, 0.06, (0.35 * length + radius + 0.07, 0, top), "x", 8)
    handle = turned(rounded_box((0.042, 0.034, grip + 0.03), 0.012), rng.uniform(-0.2, 0.1), (0, 1, 0))
    moved(handle, -0.15 * length, 0, 0.05 + grip / 2)
    battery = rounded_box((0.12, 0.07, 0.05), 0.008, (-0.12 * length, 0, 0.025))
    parts = [[barrel, handle], [battery], [chuck, bit]]
    if rng.random() < 0.5:
        for group in parts:
            for part in group:
                turned(part, np.pi / 2, (1, 0, 0))
    return thing(("plastic", parts[0]), ("black", parts[1]), ("metal", parts[2]))


def clamp(rng: np.random.Generator) -> Mesh:
    """A C-clamp or a spring clamp, lying."""
    width, depth, thick = rng.uniform((0.06, 0.04, 0.01), (0.14, 0.09, 0.02))
    bar = rng.uniform(0.01, 0.018)
    frame = [box((bar, width, thick), (0, 0, thick / 2))]
    frame += [box((depth, bar, thick), (depth / 2, s * width / 2, thick / 2)) for s in (-1, 1)]
    at = depth - 0.012
    screw = cylinder(0.005, 1.1 * width, (at, 0.4 * width, thick / 2), "y", 10)
    knob = cylinder(0.004, 0.06, (at, 0.95 * width, thick / 2), "x", 8)
    return thing((("black", "plastic")[rng.integers(2)], frame), ("metal", [screw, knob]))


def wood_block(rng: np.random.Generator) -> Mesh:
    """A block of wood or foam."""
    x, y, z = rng.uniform((0.04, 0.04, 0.03), (0.10, 0.12, 0.25))
    return thing((("wood", "wood", "foam")[rng.integers(3)], [box((x, y, z))]))


def holed_brick(rng: np.random.Generator) -> Mesh:
    """A brick with two to four square holes through it, flat or upright."""
    x, y, z = rng.uniform((0.05, 0.09, 0.05), (0.12, 0.24, 0.09))
    count, wall = int(rng.integers(2, 5)), 0.012
    parts = [box((wall, y, z), (s * (x - wall) / 2, 0, 0)) for s in (-1, 1)]
    parts += [box((x, wall, z), (0, at, 0)) for at in np.linspace(-1, 1, count + 1) * (y - wall) / 2]
    if rng.random() < 0.4:
        for part in parts:
            turned(part, np.pi / 2, (1, 0, 0))
    return thing((("brick", "foam", "plastic")[rng.integers(3)], parts))


def studded(rng: np.random.Generator) -> Mesh:
    """Building bricks with studs: one, or a stack."""
    unit = rng.uniform(0.008, 0.032)
    bricks, studs, level = [], [], 0.0
    for _ in range(rng.integers(1, 4)):
        nx, ny = int(rng.integers(1, 4)), int(rng.integers(2, 5))
        shift = rng.integers(-1, 2, 2) * unit
        height = 0.6 * unit * rng.integers(1, 3)
        bricks.append(moved(box((nx * unit, ny * unit, height)), shift[0], shift[1], level + height / 2))
        for i in range(nx):
            for j in range(ny):
                at = shift + unit * np.array([i - (nx - 1) / 2, j - (ny - 1) / 2])
                center = (float(at[0]), float(at[1]), level + height + 0.1 * unit)
                studs.append(cylinder(0.3 * unit, 0.2 * unit, center, around=8))
        level += height
    return thing(("plastic", bricks), ("plastic", studs))


def toy_car(rng: np.random.Generator) -> Mesh:
    """A car or a lorry on four wheels."""
    x, y, z = rng.uniform((0.07, 0.035, 0.02), (0.2, 0.08, 0.05))
    wheel = 0.45 * z
    body = rounded_box((x, y, z), 0.3 * z, (0, 0, wheel + z / 2))
    cabin = rounded_box(
        (rng.uniform(0.3, 0.6) * x, 0.9 * y, 0.8 * z),
        0.25 * z,
        (rng.uniform(-0.2, 0.2) * x, 0, wheel + 1.35 * z),
    )
    wheels = [
        cylinder(wheel, 0.2 * y, (sx * 0.33 * x, sy * y / 2, wheel), "y", 14)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return thing(("plastic", [body]), ("any", [cabin]), ("black", wheels))


def cubes(rng: np.random.Generator) -> Mesh:
    """A puzzle cube with coloured stickers, or dice."""
    if rng.random() < 0.5:
        side = rng.uniform(0.05, 0.07)
        return thing(("stickers", [rounded_box((side, side, side), 0.003)]))
    side, dice = rng.uniform(0.012, 0.03), []
    for _ in range(rng.integers(2, 6)):
        x, y = rng.uniform(-0.06, 0.06, 2)
        dice.append(box((side, side, side), (x, y, side / 2), rng.uniform(0, 3)))
    return thing((("plastic", "wood", "print")[rng.integers(3)], dice))


def gripper_fingers(rng: np.random.Generator) -> Mesh:
    """A robot's hand from above: two fingers below a body."""
    opening, length = rng.uniform(0.0, 0.08), rng.uniform(0.05, 0.09)
    fingers = [box((0.02, 0.014, length), (0, s * (opening + 0.014) / 2, length / 2)) for s in (-1, 1)]
    hand = rounded_box((0.06, 0.2, 0.07), 0.015, (0, 0, length + 0.035))
    flange = cylinder(0.045, 0.08, (0, 0, length + 0.11), around=24)
    return thing(
        (("black", "metal")[rng.integers(2)], fingers), (("white", "black")[rng.integers(2)], [hand, flange])
    )


def cage(rng: np.random.Generator) -> Mesh:
    """A rack of rods: a dish rack, a card holder, a toast rack."""
    x, y, z = rng.uniform((0.08, 0.12, 0.05), (0.25, 0.32, 0.14))
    ends = [(s * x / 2, h) for s in (-1, 1) for h in (0.003, z)]
    rods = [between((at, -y / 2, h), (at, y / 2, h), 0.003, 5) for at, h in ends]
    for at in np.linspace(-1, 1, int(rng.integers(4, 7))) * y / 2:
        rods.append(between((-x / 2, at, 0.003), (x / 2, at, 0.003), 0.0025, 5))
        rods += [between((s * x / 2, at, 0.003), (s * x / 2, at, z), 0.0025, 5) for s in (-1, 1)]
    return thing((("metal", "black", "white")[rng.integers(3)], rods))


KINDS = (
    drill, drill, clamp, wood_block, wood_block, holed_brick, studded, toy_car, cubes, gripper_fingers, cage,
)  # fmt: skip
