"""Bowls: thin and thick, flat and round, with vertical, conical and flared walls, on discs and foot rings.

The kinds below the line are held out for testing; no training bowl has their profiles or sections.

docs/training.md has their distance from the training kinds.

| side     | split | section | outer curve from the base radius up to the rim                    |
| -------- | ----- | ------- | ----------------------------------------------------------------- |
| round    | train | round   | superellipse quarter, exponent 1.7-2.6                            |
| conical  | train | round   | superellipse quarter, exponent 1.03-1.35                          |
| vertical | train | round   | superellipse quarter, exponent 3.5-8                              |
| cap      | train | round   | arc of a circle that ends before it is upright                    |
| flared   | train | round   | round below, lip turned outwards                                  |
| -------- | ----- | ------- | ----------------------------------------------------------------- |
| faceted  | test  | octagon | r grows as height to the power 0.4-0.65                           |
| lobed    | test  | 8 lobes | superellipse quarter, exponent 1.5-2.4                            |
| ogee     | test  | round   | round below, waist, opened rim                                    |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim_assets.objects.profiles import Curve, resample, smoothstep, superellipse_arc
from sim_assets.objects.solids import Lathe, LobedSection, PolygonSection, Section, Solid
from sim_assets.objects.vessel import Vessel, Wall, make_vessel

BowlSide = Literal["round", "conical", "vertical", "cap", "flared", "faceted", "lobed", "ogee"]
SIDES: dict[str, tuple[BowlSide, ...]] = {
    "train": ("round", "conical", "vertical", "cap", "flared"),
    "test": ("faceted", "lobed", "ogee"),
}
MATERIALS = {"ceramic": 2300.0, "glass": 2500.0, "wood": 700.0, "melamine": 1500.0}  # density in [kg/m³]


@dataclass(frozen=True)
class BowlParameters:
    """Lengths in [m].

    Attributes:
        shape: parameter of the side curve: exponent, arc angle [rad] or power.
        base_radius: radius at which the side curve starts.
        flare: outward displacement of the lip, relative to the radius.
    """

    side: BowlSide
    radius: float
    height: float
    base_radius: float
    shape: float
    flare: float
    wall: Wall
    density: float


def bowl_vessel(parameters: BowlParameters) -> Vessel:
    unit = _unit_side(parameters)
    r = parameters.base_radius + (parameters.radius - parameters.base_radius) * unit[:, 0] / unit[:, 0].max()
    z = (parameters.height - parameters.wall.foot_height) * unit[:, 1]
    return make_vessel(resample(np.stack([r, z], axis=1), 48), parameters.height, parameters.wall)


def bowl_solid(parameters: BowlParameters) -> Solid:
    return Solid(Lathe(bowl_vessel(parameters).profile, bowl_section(parameters)))


def bowl_section(parameters: BowlParameters) -> Section | None:
    """Return the horizontal section of a bowl, None for a circle."""
    if parameters.side == "faceted":
        return PolygonSection(corners=8)
    return LobedSection(lobes=8, depth=0.06) if parameters.side == "lobed" else None


def _unit_side(parameters: BowlParameters) -> Curve:
    """Return the (k, 2) rising curve from (0, 0) to (about 1, 1)."""
    if parameters.side == "cap":
        angle = np.linspace(0.0, parameters.shape, 80)
        return np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=1) / (
            np.sin(parameters.shape),
            1.0 - np.cos(parameters.shape),
        )
    if parameters.side == "faceted":
        z = np.linspace(0.0, 1.0, 160) ** 2
        return np.stack([z**parameters.shape, z], axis=1)
    quarter = superellipse_arc(parameters.shape)[100:]  # (1, 0) down to (0, -1)
    curve = np.stack([quarter[:, 0], 1.0 + quarter[:, 1]], axis=1)[::-1].copy()
    z = curve[:, 1]
    if parameters.side == "flared":
        curve[:, 0] += parameters.flare * smoothstep((z - 0.5) / 0.5) * z
    if parameters.side == "ogee":
        curve[:, 0] += parameters.flare * (
            smoothstep((z - 0.55) / 0.45) - 0.8 * np.exp(-(((z - 0.62) / 0.2) ** 2))
        )
    return curve


def sample_bowl(split: str, rng: np.random.Generator) -> BowlParameters:
    """Sample a bowl of the split's families."""
    side: BowlSide = rng.choice(SIDES[split])
    radius = rng.uniform(0.045, 0.090)
    height = float(np.clip(radius * rng.uniform(0.55, 1.15), 0.035, 0.090))
    shape = {
        "round": rng.uniform(1.7, 2.6),
        "conical": rng.uniform(1.03, 1.35),
        "vertical": rng.uniform(3.5, 8.0),
        "cap": rng.uniform(0.9, 1.4),
        "flared": rng.uniform(1.6, 2.3),
        "faceted": rng.uniform(0.4, 0.65),
        "lobed": rng.uniform(1.5, 2.4),
        "ogee": rng.uniform(1.7, 2.2),
    }[side]
    low, high = {"vertical": (0.35, 0.9), "cap": (0.2, 0.6), "lobed": (0.35, 0.65)}.get(side, (0.28, 0.62))
    thin = rng.random() < 0.35
    rim = rng.uniform(0.0015 if split == "train" else 0.002, 0.003) if thin else rng.uniform(0.003, 0.007)
    base = float(np.clip(rim * rng.uniform(1.0, 1.7), 0.0015, 0.009))
    floor = base * rng.uniform(1.0, 1.5) if rng.random() < 0.6 else rng.uniform(0.006, 0.016)
    foot = rng.choice(("none", "ring", "disc"), p=(0.4, 0.4, 0.2))
    base_radius = radius * rng.uniform(low, high)
    wall = Wall(
        base=base,
        rim=rim,
        floor=max(float(floor), 0.002),
        base_fillet=rng.uniform(0.001, 0.006) if side == "vertical" else 0.001,
        inner_fillet=rng.uniform(0.0, 0.012),
        foot_height=0.0 if foot == "none" else rng.uniform(0.003, 0.010),
        foot_ring=rng.uniform(0.003, 0.007) if foot == "ring" else 0.0,
    )
    flare = {"flared": rng.uniform(0.08, 0.3), "ogee": rng.uniform(0.10, 0.18)}.get(side, 0.0)
    density = MATERIALS[rng.choice(tuple(MATERIALS), p=(0.5, 0.2, 0.15, 0.15))]
    return BowlParameters(side, radius, height, base_radius, shape, flare, wall, density)
