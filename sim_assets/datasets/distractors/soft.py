"""Soft and living things: cloth, bags, hands, gloves, plants, cables."""

from __future__ import annotations

import cv2
import numpy as np

from sim_assets.datasets.distractors.shapes import (
    Mesh,
    ball,
    between,
    hull,
    lathe,
    loft,
    mapped,
    moved,
    sheet,
    thing,
    tube,
    turned,
)


def cloth(rng: np.random.Generator) -> Mesh:
    """A crumpled cloth or a folded towel."""
    count = 18
    x, y = rng.uniform(0.12, 0.36, 2)
    u, v = np.meshgrid(*[np.linspace(-1, 1, count)] * 2, indexing="ij")
    field = cv2.GaussianBlur(rng.standard_normal((count, count)), (0, 0), rng.uniform(1.2, 3.5))
    height = rng.uniform(0.008, 0.05) * np.clip(1 + 0.6 * field / field.std(), 0.1, 2.5)
    height *= np.clip(2.5 * (1.1 - np.maximum(np.abs(u), np.abs(v))), 0, 1)  # its edges lie on the table
    shift = cv2.GaussianBlur(rng.standard_normal((count, count, 2)), (0, 0), 3)
    top = np.stack([x / 2 * u, y / 2 * v, height + 0.006], axis=-1)
    top[..., :2] += 0.15 * min(x, y) * shift
    return thing(("fabric", [sheet(top, 0.005)]))


def bag(rng: np.random.Generator) -> Mesh:
    """A sack, a handbag or a rucksack that has slumped."""
    x, y, z = rng.uniform((0.06, 0.13, 0.1), (0.13, 0.3, 0.3))
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    at = np.linspace(0, 1, 9)
    wide = 1 - 0.35 * at**2 + 0.1 * np.sin(np.pi * at)
    dents = 1 + 0.15 * cv2.GaussianBlur(rng.standard_normal((9, 24)), (0, 0), 1.2)
    round_off = np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle))) ** 0.7  # squarer than an ellipse
    ring = np.stack([x / 2 * np.cos(angle), y / 2 * np.sin(angle)], axis=-1) / round_off[:, None]
    points = np.concatenate(
        [ring * (wide[:, None] * dents)[..., None], np.broadcast_to(z * at[:, None, None], (9, 24, 1))],
        axis=-1,
    )
    return thing((("fabric", "print", "plastic")[rng.integers(3)], [loft(points)]))


def _fingers(rng: np.random.Generator, radius: float) -> list[Mesh]:
    """Return palm, fingers and thumb of a bent hand, palm over the origin, fingers along +x."""
    bend = rng.uniform(0.1, 1.2)
    parts = [ball((0.05, 0.042, 0.016), (0, 0, 0.045), 1)]
    for index in range(4):
        y = (index - 1.5) * 0.02
        knuckle = np.array([0.04, y, 0.05])
        middle = knuckle + 0.04 * np.array([np.cos(0.3 * bend), 0, -np.sin(0.3 * bend)])
        tip = middle + 0.035 * np.array([np.cos(bend), 0, -np.sin(bend)])
        parts += [between(knuckle, middle, radius, 8), between(middle, tip, 0.9 * radius, 8)]
    parts.append(between((-0.01, -0.04, 0.045), (0.045, -0.06, 0.03), 1.1 * radius, 8))
    return parts


def hand(rng: np.random.Generator) -> Mesh:
    """A hand and a forearm that reach over the table."""
    parts = _fingers(rng, rng.uniform(0.008, 0.011))
    length, rise = rng.uniform(0.12, 0.26), rng.uniform(0.0, 0.2)
    arm = between((-0.04, 0, 0.05), (-0.04 - length, 0, 0.05 + rise), rng.uniform(0.026, 0.036), 16)
    if rng.random() < 0.6:
        return thing(("skin", parts), ("fabric", [arm]))
    return thing(("skin", [*parts, arm]))


def glove(rng: np.random.Generator) -> Mesh:
    """An empty glove, flat on the table."""
    parts = _fingers(rng, 0.012)
    parts.append(moved(ball((0.05, 0.04, 0.02)), -0.06, 0, 0.045))
    return thing((("fabric", "rubber")[rng.integers(2)], parts))


def plant(rng: np.random.Generator) -> Mesh:
    """A plant in a pot: long or broad leaves that hang or stand."""
    radius, height = rng.uniform(0.035, 0.09), rng.uniform(0.06, 0.14)
    pot = lathe([(0, 0), (0.72 * radius, 0), (0.97 * radius, height), (0, height)], 28)
    lip, wet = radius + 0.004, 0.9 * radius
    rim = lathe(
        [(wet, height - 0.015), (lip, height - 0.015), (lip, height), (wet, height), (wet, height - 0.015)]
    )
    soil = lathe([(0, height - 0.01), (wet, height - 0.01), (wet, height), (0, height + 0.001)], 20)
    top = min(0.40 - height, rng.uniform(0.06, 0.26))
    leaves, stems = [], []
    broad, t = rng.uniform(0.006, 0.035), np.linspace(0, 1, 7)
    for _ in range(rng.integers(6, 20)):
        out, azimuth, rise = rng.uniform(0.03, 0.15), rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.0) * top
        droop = rng.uniform(0, 0.8) * rise
        path = np.stack([out * t, 0 * t, height + rise * t - droop * t**3], axis=1)
        wide = broad * np.sqrt(np.maximum(1 - (2 * t - 1.05) ** 2, 0.01))
        edge = np.stack([0 * t, wide, 0 * t], axis=1)
        fold = np.stack([0 * t, 0 * t, 0.3 * wide], axis=1)
        rings = np.stack(
            [
                path - edge + fold,
                path - np.array([0, 0, 0.001]),
                path + edge + fold,
                path + np.array([0, 0, 0.001]),
            ],
            axis=1,
        )
        leaf = turned(loft(rings), azimuth)
        leaves.append(leaf)
    if rng.random() < 0.3:
        stems = [between((0, 0, height), (0, 0, height + 0.6 * top), 0.004, 6)]
    surface = ("clay", "ceramic", "plastic", "wicker")[rng.integers(4)]
    return thing((surface, [pot, rim]), ("soil", [soil]), ("leaf", [*leaves, *stems]))


def cable(rng: np.random.Generator) -> Mesh:
    """A cable or a rope in loops, perhaps with a plug."""
    count = 70
    t = np.linspace(0, 2 * np.pi * rng.uniform(0.8, 3.0), count)
    wander = cv2.GaussianBlur(rng.standard_normal((count, 2)), (0, 0), sigmaX=0.1, sigmaY=8)
    size = rng.uniform(0.03, 0.11)
    path = size * np.stack([np.cos(t) * (1 + 0.1 * t), np.sin(t)], axis=1)
    path += 0.5 * size * wander / max(float(wander.std()), 1e-6) * np.linspace(0, 1, count)[:, None]
    path *= min(1.0, 0.38 / float(np.ptp(path, axis=0).max()))
    radius = rng.uniform(0.0018, 0.006)
    lift = radius + 1.5 * radius * (1 + np.sin(1.3 * t))
    parts = [tube(np.column_stack([path, lift]), radius, 6)]
    plugs = [hull(path3 + rng.normal(0, 0.008, (12, 3))) for path3 in [np.array([*path[-1], 0.012])]]
    return thing((("black", "white", "any")[rng.integers(3)], parts), ("black", plugs))


def plush(rng: np.random.Generator) -> Mesh:
    """A soft toy: a body, a head with ears, four limbs."""
    r = rng.uniform(0.03, 0.055)
    parts = [ball((r, r, 1.2 * r), (0, 0, 1.2 * r)), ball(0.8 * r, (0, 0, 2.9 * r))]
    parts += [ball(0.3 * r, (0, s * 0.6 * r, 3.6 * r), 1) for s in (-1, 1)]
    parts += [
        between((0.4 * r, s * 0.5 * r, 0.4 * r), (1.4 * r, s * 0.8 * r, 0.4 * r), 0.35 * r, 8)
        for s in (-1, 1)
    ]
    parts += [
        between((0.1 * r, s * 0.8 * r, 1.8 * r), (0.7 * r, s * 1.5 * r, 1.2 * r), 0.28 * r, 8)
        for s in (-1, 1)
    ]
    return thing(("fabric", [parts[0], *parts[2:]]), ("fabric", parts[1:2]))


def stone(rng: np.random.Generator) -> Mesh:
    """A stone, a potato or a lump of dough."""
    mesh = ball(1.0)
    directions = rng.normal(size=(5, 3))
    bumps = 1 + sum(0.12 * rng.normal() * np.tanh(mesh.vertices @ d) for d in directions)
    mesh.vertices = mesh.vertices * np.asarray(bumps)[:, None] * rng.uniform(0.02, 0.07, 3)
    return thing((("marble", "bread", "clay")[rng.integers(3)], [mapped(mesh)]))


KINDS = (cloth, cloth, bag, bag, hand, hand, glove, plant, plant, plant, cable, cable, plush, stone)
