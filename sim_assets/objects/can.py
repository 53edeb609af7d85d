"""Cans: drink cans, food tins, plain tins and canisters, slim to wide.

Held out for testing are the kinds below the line, which combine features of the training kinds.

| kind      | split | body                           | ends                                             |
| --------- | ----- | ------------------------------ | ------------------------------------------------ |
| food      | train | straight                       | seamed rims standing out, sunk panels, both ends |
| drink     | train | straight                       | necked top with a seam, chamfered bottom, dome   |
| plain     | train | straight                       | flat, rounded edges                              |
| canister  | train | straight                       | lid wider than the body                          |
| --------- | ----- | ------------------------------ | ------------------------------------------------ |
| beaded    | test  | shallow ribs around the middle | seamed rim above, stackable (drawn in) below     |
| stackable | test  | straight, drawn in below       | seamed rim, sunk panel                           |
| necked    | test  | straight                       | necked both ends, seamed rim                     |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim_assets.objects.profiles import Curve, soften
from sim_assets.objects.solids import Lathe, Solid

CanKind = Literal["food", "drink", "plain", "canister", "beaded", "stackable", "necked"]
KINDS: dict[str, tuple[CanKind, ...]] = {
    "train": ("food", "drink", "plain", "canister"),
    "test": ("beaded", "stackable", "necked"),
}
WIDEST = 0.038  # radius that an 80 mm gripper still holds [m]
FOOT = (0.002, 0.006)  # [m] by which a drawn-in bottom is narrower


@dataclass(frozen=True)
class CanParameters:
    """Lengths in [m].

    Attributes:
        radius: largest of the whole can.
        seam: radial step between seam and body, or lid and body; rim: height of the seam or lid.
        neck: how far the top is drawn in; neck_height: over what height.
        recess: depth of the panels below the rim; dome: depth of the hollow underneath.
        foot: how far the bottom is drawn in.
        beads: depth of the ribs.
        density: mass over the volume enclosed [kg/m³], contents included.
    """

    kind: CanKind
    radius: float
    height: float
    seam: float
    rim: float
    neck: float
    neck_height: float
    recess: float
    dome: float
    foot: float
    beads: float
    density: float


def can_profile(parameters: CanParameters) -> Curve:
    """The closed profile (r, z)."""
    p = parameters
    body = p.radius - (p.seam if p.neck == 0 else 0.0)
    parts = [_bottom(p, body)]
    low, high = 0.18 * p.height, 0.82 * p.height
    if p.beads > 0:
        z = np.linspace(low, high, 61)
        ripple = 0.5 - 0.5 * np.cos(2 * np.pi * np.round((high - low) / 0.009) * (z - low) / (high - low))
        parts.append(np.stack([body - p.beads * ripple, z], axis=1))
    parts.append(_top(p, body))
    return soften(np.concatenate(parts), 0.0012, angle=0.5)


def can_solid(parameters: CanParameters) -> Solid:
    return Solid(Lathe(can_profile(parameters)))


def _bottom(p: CanParameters, body: float) -> Curve:
    """From the axis over the underside to the foot of the body."""
    if p.foot > 0:  # drawn in to a standing ring
        stand = body - p.foot
        hollow = (
            [(0.0, p.dome), (0.6 * stand, 0.8 * p.dome), (stand - 0.004, 0.0)] if p.dome > 0 else [(0.0, 0.0)]
        )
        return np.array([*hollow, (stand, 0.0), (stand, 0.0025), (body, 0.0025 + 1.1 * p.foot)])
    if p.kind == "food":
        seam = p.radius
        hollow = [(0.0, p.recess), (seam - 0.003, p.recess), (seam - 0.003, 0.0)]
        return np.array([*hollow, (seam, 0.0), (seam, p.rim), (body, p.rim + p.seam)])
    return np.array([(0.0, 0.0), (body, 0.0)])


def _top(p: CanParameters, body: float) -> Curve:
    """From the top of the body over rim or lid to the axis."""
    if p.kind == "plain":
        return np.array([(body, p.height), (0.0, p.height)])
    if p.kind == "canister":
        step = p.height - p.rim
        lid = [(body, step), (p.radius, step), (p.radius, p.height)]
        inside = p.radius - 0.004
        return np.array(
            [*lid, (inside, p.height), (inside - 0.001, p.height - p.recess), (0.0, p.height - p.recess)]
        )
    seam = p.radius - p.neck if p.neck > 0 else p.radius
    under = seam - max(p.seam, 0.0008)
    rim_bottom = p.height - p.rim
    inside = seam - 0.003
    return np.array(
        [
            (body, rim_bottom - p.neck_height - 0.001),
            (under, rim_bottom - 0.001),
            (seam, rim_bottom),
            (seam, p.height),
            (inside, p.height),
            (inside - 0.001, p.height - p.recess),
            (0.0, p.height - p.recess),
        ]
    )


def sample_can(split: str, rng: np.random.Generator) -> CanParameters:
    """Draw a can of the split's families."""
    kind: CanKind = rng.choice(KINDS[split])
    radius = rng.uniform(0.024, WIDEST)
    height = float(np.clip(2.0 * radius * rng.uniform(0.9, 2.9), 0.060, 0.170))
    necked = kind in ("drink", "necked")
    drawn_in = kind in ("drink", "beaded", "stackable", "necked")
    neck = rng.uniform(0.002, 0.007) if necked else 0.0
    return CanParameters(
        kind=kind,
        radius=float(radius),
        height=height,
        seam=0.0 if kind == "plain" else float(rng.uniform(0.0006, 0.0018)),
        rim=float(rng.uniform(0.006, 0.016) if kind == "canister" else rng.uniform(0.002, 0.0035)),
        neck=float(neck),
        neck_height=float(neck * rng.uniform(1.2, 2.2)) if necked else 0.001,
        recess=0.0 if kind == "plain" else float(rng.uniform(0.0015, 0.005)),
        dome=float(rng.uniform(0.003, 0.009)) if necked else 0.0,
        foot=float(rng.uniform(*FOOT)) if drawn_in else 0.0,
        beads=float(rng.uniform(0.0004, 0.0011)) if kind == "beaded" else 0.0,
        density=float(rng.uniform(350.0, 1050.0)),
    )
