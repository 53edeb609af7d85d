"""Initial positions of the toys: one above each object, the others distributed over the scene."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from perception.types import ObjectEstimate
from sim_assets.cell.drop_world import Toy, ToyKind
from sim_assets.objects.convex.perceived_mesh import PolarBody

DROP_HEIGHT = 0.10  # [m] above the surface beneath
FIRST, EVERY = 0.15, 0.11  # [s]: time of the first drop, interval of the others
BALL = 0.013  # [m] radius of a ball
SNUG = 0.42  # largest radius of a ball as a share of the opening, so that it can roll inside
LEAST_BALL = 0.005  # [m] smallest radius of a ball
RAIN_KINDS: tuple[ToyKind, ...] = ("ball", "die", "ball", "pill")


def plan_drops(
    objects: Sequence[ObjectEstimate],
    bodies: Sequence[PolarBody],
    up: Float[np.ndarray, "3"],
    count: int,
    rng: np.random.Generator,
) -> list[Toy]:
    """Return the toys in order of release: one above each object first, then random ones around them."""
    order = rng.permutation(len(objects))
    toys = [_onto(objects[i], bodies[i], up, rng) for i in order][:count]
    toys += _rain(objects, up, count - len(toys), rng)
    return [
        Toy(kind, size, position, FIRST + EVERY * i, _color(i, rng))
        for i, (kind, size, position) in enumerate(toys)
    ]


def rim_radius(body: PolarBody) -> float:
    """Return the radius of the opening at the top in metres; 0 for a closed body."""
    if body.floor >= len(body.z) - 1:
        return 0.0
    return float(body.inner[body.floor + 1 :].mean(axis=1)[-3:].min())


def _onto(
    estimate: ObjectEstimate, body: PolarBody, up: np.ndarray, rng: np.random.Generator
) -> tuple[ToyKind, float, np.ndarray]:
    """Return a ball above the opening of a body, or beside the centre of a closed top."""
    opening = rim_radius(body)
    deep = body.z[-1] - body.z[body.floor] > 0.3 * np.ptp(body.z)
    size = max(min(BALL, SNUG * opening), LEAST_BALL) if deep else BALL
    aside = 0.25 * opening if deep else 0.3 * float(body.outer[-3:].mean())
    angle = rng.uniform(0, 2 * np.pi)
    local = np.array([*(body.axis + aside * np.array([np.cos(angle), np.sin(angle)])), body.z[-1]])
    T = estimate.T_world_object
    return "ball", size, T[:3, :3] @ local + T[:3, 3] + (DROP_HEIGHT + size) * up


def _rain(
    objects: Sequence[ObjectEstimate], up: np.ndarray, count: int, rng: np.random.Generator
) -> list[tuple[ToyKind, float, np.ndarray]]:
    """Return toys around random objects, above the tallest one."""
    toys: list[tuple[ToyKind, float, np.ndarray]] = []
    tallest = max(float((estimate.mesh_world.vertices @ up).max()) for estimate in objects)
    for index in range(max(count, 0)):
        target = objects[int(rng.integers(len(objects)))]
        size = float(rng.uniform(0.6, 1.1)) * BALL
        spread = rng.normal(0, 1.0, 3) * 1.1 * target.radius
        position = target.T_world_object[:3, 3] + spread
        position += (tallest + DROP_HEIGHT - position @ up) * up
        toys.append((RAIN_KINDS[index % len(RAIN_KINDS)], size, position))
    return toys


def _color(index: int, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a saturated colour that differs from that of the previous toy."""
    return colorsys.hsv_to_rgb((0.02 + 0.382 * index) % 1.0, float(rng.uniform(0.75, 0.95)), 0.95)
