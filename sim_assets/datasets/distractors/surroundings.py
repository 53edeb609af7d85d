"""What stands or hangs around a table, 0.3 to 1.6 m in size: furniture, walls, screens, piles, people."""

from __future__ import annotations

import itertools

import numpy as np

from sim_assets.datasets.distractors.shapes import (
    Mesh,
    ball,
    between,
    box,
    cylinder,
    lathe,
    moved,
    rounded_box,
    sheet,
    thing,
    tube,
    turned,
)


def chair(rng: np.random.Generator) -> Mesh:
    """A chair with four legs and a back, or an office chair."""
    side, seat, back = rng.uniform((0.38, 0.40, 0.3), (0.5, 0.5, 0.55))
    cushion = rounded_box((side, side, 0.05), 0.04, (0, 0, seat))
    rest = rounded_box((0.03, side, back), 0.01, (-side / 2, 0, seat + 0.12 + back / 2))
    posts = [
        between((-side / 2, s * 0.4 * side, seat), (-side / 2, s * 0.4 * side, seat + 0.3), 0.015)
        for s in (-1, 1)
    ]
    if rng.random() < 0.6:
        low, high = 0.45 * side, 0.42 * side
        corners = [(x, y) for x in (-1, 1) for y in (-1, 1)]
        legs = [between((low * x, low * y, 0.02), (high * x, high * y, seat), 0.018) for x, y in corners]
    else:
        legs = [cylinder(0.03, seat, (0, 0, seat / 2))]
        legs += [
            between((0, 0, 0.08), (0.3 * np.cos(a), 0.3 * np.sin(a), 0.03), 0.02)
            for a in np.arange(5) * 1.2566
        ]
    return thing(
        (("wood", "black", "metal")[rng.integers(3)], [*legs, *posts]),
        (("fabric", "wood")[rng.integers(2)], [cushion, rest]),
    )


def cupboard(rng: np.random.Generator) -> Mesh:
    """A cupboard, a chest of drawers or a fridge, with doors and knobs."""
    x, y, z = rng.uniform((0.35, 0.4, 0.5), (0.6, 1.2, 1.5))
    rows, columns = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    doors, knobs = [], []
    for i in range(rows):
        for j in range(columns):
            w, h = y / columns, z / rows
            at = (x / 2, (j - (columns - 1) / 2) * w, (i + 0.5) * h)
            doors.append(box((0.02, w - 0.012, h - 0.012), at))
            knobs.append(ball(0.015, (x / 2 + 0.02, at[1] + 0.35 * w, at[2]), 1))
    surface = ("wood", "white", "plastic", "metal")[rng.integers(4)]
    return thing((surface, [box((x, y, z), (0, 0, z / 2))]), (surface, doors), ("metal", knobs))


def shelf(rng: np.random.Generator) -> Mesh:
    """A shelf with boards, books and boxes in it."""
    x, y, z = rng.uniform((0.22, 0.5, 0.6), (0.4, 1.2, 1.5))
    count = int(rng.integers(3, 6))
    boards = [box((x, y, 0.02), (0, 0, at)) for at in np.linspace(0.01, z - 0.01, count)]
    boards += [box((x, 0.02, z), (0, s * y / 2, z / 2)) for s in (-1, 1)]
    if rng.random() < 0.5:
        boards.append(box((0.01, y, z), (-x / 2, 0, z / 2)))
    covers, cartons, room = [], [], z / (count - 1)
    for level in np.linspace(0.02, z, count)[:-1]:
        at = -0.48 * y
        while at < 0.4 * y:
            wide = rng.uniform(0.015, 0.06) if rng.random() < 0.8 else rng.uniform(0.08, 0.2)
            high = rng.uniform(0.4, 0.9) * room
            part = box(
                (rng.uniform(0.5, 0.9) * x, wide, high), (0, min(at + wide / 2, 0.47 * y), level + high / 2)
            )
            (covers if wide < 0.07 else cartons).append(part)
            at += wide + (rng.uniform(0.05, 0.25) if rng.random() < 0.12 else 0.001)
    groups = [
        ("wood" if rng.random() < 0.6 else "white", boards),
        ("cover", covers[::2]),
        ("cover", covers[1::2]),
    ]
    return thing(*[g for g in [*groups, ("print", cartons)] if g[1]])


def box_pile(rng: np.random.Generator) -> Mesh:
    """A pile of removal boxes and parcels."""
    first, second, height = [], [], 0.0
    for _ in range(rng.integers(1, 5)):
        size = rng.uniform((0.2, 0.25, 0.12), (0.45, 0.6, 0.4))
        part = box(size, (*rng.normal(0, 0.04, 2), height + size[2] / 2), rng.normal(0, 0.2))
        (first if rng.random() < 0.6 else second).append(part)
        height += size[2]
    return thing(*[g for g in (("card", first), ("print", second)) if g[1]])


def screen(rng: np.random.Generator) -> Mesh:
    """A large screen on its foot or a television."""
    width = rng.uniform(0.45, 1.2)
    height, lift = width * rng.uniform(0.5, 0.66), rng.uniform(0.08, 0.6)
    case = box((0.05, width, height), (0, 0, lift + height / 2))
    front = box((0.002, 0.96 * width, 0.94 * height), (0.026, 0, lift + height / 2))
    stand = [
        box((0.03, 0.08, lift + 0.1), (-0.03, 0, (lift + 0.1) / 2)),
        box((0.24, 0.5 * width, 0.02), (0, 0, 0.01)),
    ]
    return thing(("black", [case, *stand]), ("screen", [front]))


def person(rng: np.random.Generator) -> Mesh:
    """A person's trunk, head and arms, sitting or standing behind a table."""
    hip, chest = rng.uniform(0.35, 0.6), rng.uniform(0.4, 0.55)
    wide = rng.uniform(0.15, 0.2)
    shoulder = hip + chest
    trunk = between((0, 0, hip), (0, 0, shoulder - 0.1), wide, 16)
    trunk.apply_scale((0.7, 1.15, 1))
    legs = [between((0, s * 0.1, 0.08), (0, s * 0.1, hip), 0.08, 12) for s in (-1, 1)]
    arms, hands = [], []
    for s in (-1, 1):
        elbow = np.array([rng.uniform(0, 0.2), s * (wide + 0.12), shoulder - 0.28])
        palm = np.array([0.05, 0, 0])
        wrist = elbow + rng.uniform((0.1, -0.15, -0.15), (0.25, 0.0, 0.15)) * (1, s, 1)
        arms += [between((0, s * (wide + 0.02), shoulder - 0.02), elbow, 0.05), between(elbow, wrist, 0.04)]
        hands.append(ball((0.07, 0.045, 0.03), wrist + palm, 1))
    head = [
        ball((0.09, 0.075, 0.11), (0, 0, shoulder + 0.24)),
        between((0, 0, shoulder), (0, 0, shoulder + 0.16), 0.05),
    ]
    return thing(("fabric", [trunk, *arms]), ("fabric", legs), ("skin", [*head, *hands]))


def floor_lamp(rng: np.random.Generator) -> Mesh:
    """A lamp on a pole."""
    height, r = rng.uniform(0.9, 1.5), rng.uniform(0.1, 0.2)
    parts = [lathe([(0, 0), (0.14, 0), (0.14, 0.02), (0, 0.03)]), cylinder(0.012, height, (0, 0, height / 2))]
    shade = lathe([(r - 0.003, 0), (r, 0), (0.6 * r, 0.22), (0.6 * r - 0.003, 0.22), (r - 0.003, 0)], 32)
    return thing(("metal", parts), ("fabric", [moved(shade, 0, 0, height - 0.2)]))


def curtain(rng: np.random.Generator) -> Mesh:
    """A curtain that hangs in folds, or a coat."""
    width, height = rng.uniform((0.4, 0.7), (1.2, 1.6))
    u, v = np.meshgrid(np.linspace(0, height, 5), np.linspace(-width / 2, width / 2, 60), indexing="ij")
    folds = rng.uniform(0.02, 0.06) * np.sin(rng.uniform(10, 30) * v + 0.5 * np.sin(3 * u))
    mesh = sheet(np.stack([u, v, folds], axis=-1), 0.01)
    return thing(("fabric", [turned(mesh, -np.pi / 2, (0, 1, 0))]))


def wall_piece(rng: np.random.Generator) -> Mesh:
    """A part of a wall, a door or a partition, with a frame, a picture or a window in it."""
    y, z = rng.uniform((0.5, 0.6), (1.6, 1.6))
    wall = box((rng.uniform(0.03, 0.15), y, z), (0, 0, z / 2))
    front = wall.bounds[1, 0]
    w, h = rng.uniform(0.3, 0.8, 2) * (y, z)
    picture = box((0.02, w, h), (front, 0, z * 0.5))
    frame = [box((0.04, w + 0.06, 0.03), (front, 0, z * 0.5 + s * h / 2)) for s in (-1, 1)]
    frame += [box((0.04, 0.03, h), (front, s * (w / 2 + 0.015), z * 0.5)) for s in (-1, 1)]
    base = box((wall.extents[0] + 0.03, y, 0.08), (0, 0, 0.04))
    groups = [(("white", "any", "brick", "wood")[rng.integers(4)], [wall])]
    if rng.random() < 0.6:
        groups += [("wood", [*frame, base]), (("picture", "screen", "white")[rng.integers(3)], [picture])]
    return thing(*groups)


def radiator(rng: np.random.Generator) -> Mesh:
    """A radiator of upright ribs, or a heater."""
    count, z = int(rng.integers(6, 18)), rng.uniform(0.35, 0.7)
    ribs = [box((0.1, 0.045, z), (0, 0.055 * i, 0.08 + z / 2)) for i in range(count)]
    pipes = [
        cylinder(0.015, 0.055 * count, (0, 0.0275 * (count - 1), 0.08 + f * z), "y", 10) for f in (0.06, 0.94)
    ]
    legs = [box((0.06, 0.02, 0.09), (0, 0.055 * i, 0.045)) for i in (0, count - 1)]
    return thing((("white", "metal")[rng.integers(2)], [*ribs, *pipes, *legs]))


def bin_or_drum(rng: np.random.Generator) -> Mesh:
    """A waste bin, a bucket or a drum."""
    r, z = rng.uniform((0.14, 0.3), (0.3, 0.9))
    base = r * rng.uniform(0.7, 1.0)
    profile = [(0, 0), (base, 0), (r, z), (r - 0.01, z), (base - 0.01, 0.02), (0, 0.02)]
    if rng.random() < 0.4:
        profile = [(0, 0), (base, 0), (r, z), (0.9 * r, z + 0.04), (0, z + 0.06)]
    return thing((("plastic", "metal", "black", "white")[rng.integers(4)], [lathe(profile, 36)]))


def column(rng: np.random.Generator) -> Mesh:
    """A big cylinder, a post or a bundle of pipes."""
    r, z = rng.uniform((0.05, 0.6), (0.25, 1.6))
    pipes = [cylinder(0.02, z, (r + 0.04, 0.05 * i, z / 2)) for i in range(rng.integers(0, 4))]
    surface = ("white", "marble", "metal", "wood", "fabric")[rng.integers(5)]
    return thing(
        (surface, [cylinder(r, z, (0, 0, z / 2), around=32)]), *([("metal", pipes)] if pipes else [])
    )


def robot_arm(rng: np.random.Generator) -> Mesh:
    """A robot arm on its base."""
    joints = [np.zeros(3), np.array([0, 0, rng.uniform(0.25, 0.35)])]
    for length in (rng.uniform(0.25, 0.4), rng.uniform(0.2, 0.4), 0.12):
        tilt, turn = rng.uniform(0.1, 1.9), rng.uniform(-1, 1)
        step = length * np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        joints.append(joints[-1] + step)
    links = [between(a, b, 0.055 - 0.006 * i, 12) for i, (a, b) in enumerate(itertools.pairwise(joints))]
    knots = [ball(0.07 - 0.007 * i, p, 1) for i, p in enumerate(joints[1:-1])]
    base = cylinder(0.1, 0.1, (0, 0, 0.05), around=24)
    return thing(
        (("white", "metal", "plastic")[rng.integers(3)], [*links, base]),
        (("black", "white")[rng.integers(2)], knots),
    )


def tripod(rng: np.random.Generator) -> Mesh:
    """A tripod with a camera or a spotlight."""
    height, spread = rng.uniform(0.6, 1.3), rng.uniform(0.2, 0.4)
    legs = [
        between((spread * np.cos(a), spread * np.sin(a), 0.015), (0, 0, height), 0.012, 8)
        for a in (0, 2.1, 4.2)
    ]
    head = box((0.1, 0.14, 0.1), (0, 0, height + 0.06), rng.uniform(0, 3))
    cord = tube(
        np.stack([0.05 * np.sin(t := np.linspace(0, 6, 20)), 0.1 + 0 * t, height * (1 - t / 6.2)], axis=1),
        0.004,
    )
    return thing(("black", [*legs, head, cord]))


KINDS = (
    chair, chair, cupboard, cupboard, shelf, shelf, box_pile, box_pile, screen, person, person, floor_lamp,
    curtain, wall_piece, wall_piece, radiator, bin_or_drum, column, robot_arm, tripod,
)  # fmt: skip
