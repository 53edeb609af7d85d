"""Vessels of no class, for training only: cups, bowls and closed bodies with parts, or not round, or leaning.

A mug is a round cup with one loop at its side, bowls and cans are round, a bottle has parts at its top alone.
What departs from that is of no class. The departures are random: the kinds held out for testing are not
modelled here, though a vessel may resemble one of them.
"""

from __future__ import annotations

import numpy as np

from sim_assets.datasets.distractors.shapes import (
    Mesh,
    between,
    hull,
    lathe,
    mapped,
    standing,
    thing,
    tube,
    turned,
)

_AROUND = 28
_SURFACES = ("ceramic", "metal", "plastic", "fabric", "any", "black", "white")


def odd_vessel(rng: np.random.Generator) -> Mesh:
    """Return an open or closed vessel with one to three parts at its side, or with an elongated section."""
    radius, height = rng.uniform(0.025, 0.09), rng.uniform(0.03, 0.16)
    is_open = rng.random() < 0.7
    body = _body(radius, height, is_open, rng)
    stretched = rng.random() < 0.55
    parts = [] if is_open and stretched and rng.random() < 0.35 else _parts(radius, height, is_open, rng)
    if stretched:
        across = rng.uniform(0.32, 0.68)  # flasks and tins are wider than that, relative to their length
        for part in (body, *parts):
            part.apply_scale((rng.uniform(0.95, 1.3), across, 1.0))
    if rng.random() < 0.35:  # leaning, about a base that stays where it is
        lean = np.eye(4)
        lean[:2, 2] = rng.normal(0.0, 0.35, 2)
        for part in (body, *parts):
            part.apply_transform(lean)
    names = rng.choice(_SURFACES, 2)
    groups = [(str(names[0]), [body])] + ([(str(names[1]), parts)] if parts else [])
    return standing(turned(thing(*groups), rng.uniform(-np.pi, np.pi)))


def _body(radius: float, height: float, is_open: bool, rng: np.random.Generator) -> Mesh:
    """Return a body of revolution of random curve, hollow if open."""
    relative = 1.0 + 0.35 * rng.uniform(-1.0, 1.0, 4)
    u = np.linspace(0.0, 1.0, 9)
    r = radius * np.interp(u, np.linspace(0.0, 1.0, 4), relative / relative.max())
    outer = np.stack([r, u * height], axis=1)
    if not is_open:
        top = rng.uniform(0.0, 0.4) * r[-1]
        return lathe([(0, 0), *outer, (top, height * rng.uniform(1.0, 1.3)), (0, height)], _AROUND)
    wall = rng.uniform(0.002, 0.005)
    inner = np.stack([np.maximum(r - wall, 0.002), np.maximum(u * height, wall)], axis=1)[::-1]
    return lathe([(0, 0), *outer, *inner, (0, wall)], _AROUND)


def _parts(radius: float, height: float, is_open: bool, rng: np.random.Generator) -> list[Mesh]:
    """Return one to three parts in different directions that reach 0.7 to 2.2 radii [m] beyond the side.

    On closed bodies they stay below the upper third, where bottles have pumps and triggers.
    """
    parts = []
    start = rng.uniform(-np.pi, np.pi)
    for index in range(int(rng.integers(1, 4))):
        z = height * rng.uniform(0.08, 0.95 if is_open else 0.6)
        root = np.array([0.75 * radius, 0.0, z])
        reach = radius * rng.uniform(0.7, 2.2)
        part = _part(root, reach, radius, height, rng)
        parts.append(turned(part, start + 2.0 * index + rng.normal(0.0, 0.4)))
    return parts


def _part(root: np.ndarray, reach: float, radius: float, height: float, rng: np.random.Generator) -> Mesh:
    """Return a lump, a rod, a bent tube that tapers, or a bow over the mouth, all above z = 0.

    Args:
        root: (3,) where a rod or tube begins, inside the vessel [m].
        reach: how far it leads away from the axis along +x [m].
        radius, height: of the vessel [m].
        rng: source of randomness.
    """
    rise = rng.uniform(-0.5, 1.2) * min(reach, height)
    end = root + np.array([reach, 0.0, max(rise, 0.012 - root[2])])
    kind = rng.integers(4)
    if kind == 0:
        return between(root, end, rng.uniform(0.006, 0.016))
    if kind == 1:
        s = np.linspace(0.0, 1.0, 9)[:, None]
        bulge = np.array([0.0, 0.0, rng.uniform(-0.4, 0.4) * reach])
        path = root + s * (end - root) + 4.0 * s * (1.0 - s) * bulge
        path[:, 2] = np.maximum(path[:, 2], 0.008)
        return tube(
            path, np.linspace(rng.uniform(0.3, 0.6) * radius, rng.uniform(0.004, 0.4 * radius), 9), 10
        )
    if kind == 2:  # a lump on the ground, as wide as the vessel
        size = np.array([reach, radius * rng.uniform(0.6, 1.1), height * rng.uniform(0.2, 0.8)])
        points = rng.normal(size=(40, 3))
        points *= size / np.linalg.norm(points, axis=1, keepdims=True)
        points += (radius, 0.0, 0.3 * size[2])
        points[:, 2] = np.maximum(points[:, 2], 0.0)
        return hull(points)
    angle = np.linspace(0.15, np.pi - 0.15, 14)  # a bow over the mouth, or around the vessel
    bow = np.stack(
        [radius * np.cos(angle), 0 * angle, height + rng.uniform(0.6, 1.1) * radius * np.sin(angle)], 1
    )
    return mapped(tube(bow, rng.uniform(0.003, 0.008)))
