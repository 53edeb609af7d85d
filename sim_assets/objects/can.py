"""Cans: drink cans, food tins, plain tins and canisters, slim to wide.

The kinds below the line are held out for testing: their bodies are strongly curved. Those of training cans
are straight or, in the sizes met in homes (household.py), ribbed or slightly curved.

docs/training.md has their distance from the training kinds.

| kind     | split | body                                     | ends                                   |
| -------- | ----- | ---------------------------------------- | -------------------------------------- |
| food     | train | straight                                 | seamed rims standing out, sunk panels  |
| drink    | train | straight                                 | necked top with a seam, chamfered foot |
| plain    | train | straight                                 | flat, rounded edges                    |
| canister | train | straight                                 | lid wider than the body                |
| ribbed   | train | shallow, narrow ribs                     | seamed rims, sunk panels               |
| bowed    | train | slightly wider in the middle             | seamed rims, sunk panels               |
| drawn    | train | slightly narrower in the middle          | seamed rims, sunk panels               |
| conic    | train | slightly narrower above                  | seamed rims, sunk panels               |
| -------- | ----- | ---------------------------------------- | -------------------------------------- |
| beaded   | test  | deep beads all around, as on steel drums | seamed rims, sunk panels               |
| waisted  | test  | narrowest in the middle (hourglass)      | seamed rims, sunk panels               |
| keg      | test  | widest in the middle                     | seamed rims, sunk panels               |
| tapered  | test  | conical, narrower above                  | seamed rims, sunk panels               |
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sim_assets.objects.profiles import Curve, body_curve, soften
from sim_assets.objects.solids import Lathe, Solid

CanKind = Literal[
    "food", "drink", "plain", "canister", "ribbed", "bowed", "drawn", "conic",
    "beaded", "waisted", "keg", "tapered",
]  # fmt: skip
KINDS: dict[str, tuple[CanKind, ...]] = {
    "train": ("food", "drink", "plain", "canister"),
    "test": ("beaded", "waisted", "keg", "tapered"),
}
BENDS: dict[CanKind, tuple[float, float]] = {
    "beaded": (0.06, 0.10),
    "waisted": (0.14, 0.24),
    "keg": (0.14, 0.24),
    "tapered": (0.14, 0.26),
}  # of the test kinds, relative to the radius
SLIGHT_BENDS: dict[CanKind, tuple[float, float]] = {
    "ribbed": (0.012, 0.035),
    "bowed": (0.02, 0.11),
    "drawn": (0.02, 0.11),
    "conic": (0.02, 0.11),
}  # of training cans in the sizes met in homes
RIB_PITCH = 0.007  # spacing of ribs along the axis [m]
BEAD_PITCH = 0.016  # spacing of beads along the axis [m]
WIDEST = 0.038  # largest radius that an 80 mm gripper can grasp [m]
FOOT = (0.002, 0.006)  # [m], difference between the radii of body and narrowed bottom


@dataclass(frozen=True)
class CanParameters:
    """Lengths in [m].

    Attributes:
        radius: largest radius of the can.
        seam: radial step between seam and body, or lid and body; rim: height of the seam or lid.
        neck, neck_height: radial and vertical extent of the taper at the top.
        recess: depth of the panels below the rim; dome: depth of the hollow underneath.
        foot: difference between the radii of body and bottom.
        bend: depth of the beads, the waist, the belly or the taper, relative to the radius.
        density: mass over the volume enclosed [kg/m³], contents included.
        radii: relative radii of a body of free form (free_forms.py), in place of the kind's curve.
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
    bend: float
    density: float
    radii: tuple[float, ...] = ()


def can_profile(parameters: CanParameters) -> Curve:
    """Return the closed profile (r, z)."""
    p = parameters
    if p.bend > 0 or p.radii:
        return _curved_profile(p)
    body = p.radius - (p.seam if p.neck == 0 else 0.0)
    return soften(np.concatenate([_bottom(p, body), _top(p, body)]), 0.0012, angle=0.5)


def _curved_profile(p: CanParameters) -> Curve:
    """Return the profile of a curved body between two seamed ends, each a seam wider than the body there."""
    widest = p.radius if p.kind in ("keg", "bowed") else p.radius - p.seam
    low, high = p.rim + p.seam, p.height - p.rim - p.neck_height - 0.001
    beads = max(2, round((high - low) / (RIB_PITCH if p.kind == "ribbed" else BEAD_PITCH)))
    u = np.linspace(0.0, 1.0, 8 * len(p.radii) + 1 if p.radii else 16 * beads + 1)
    sides = {
        "beaded": 1.0 - p.bend * (0.5 - 0.5 * np.cos(2.0 * np.pi * beads * u)),
        "waisted": 1.0 - p.bend * (1.0 - (2.0 * u - 1.0) ** 2),
        "keg": 1.0 - p.bend * (2.0 * u - 1.0) ** 2,
        "tapered": 1.0 - p.bend * u,
    }
    slight = {"ribbed": "beaded", "bowed": "keg", "drawn": "waisted", "conic": "tapered"}
    relative = body_curve(p.radii, u) if p.radii else sides[slight.get(p.kind, p.kind)]
    body = widest * relative
    side = np.stack([body, low + u * (high - low)], axis=1)[1:-1]
    bottom = _bottom(replace(p, radius=body[0] + p.seam), body[0])
    top = _top(replace(p, radius=body[-1] + p.seam), body[-1])
    return soften(np.concatenate([bottom, side, top]), 0.0012, angle=0.5)


def can_solid(parameters: CanParameters) -> Solid:
    return Solid(Lathe(can_profile(parameters)))


def _bottom(p: CanParameters, body: float) -> Curve:
    """Return the profile from the axis over the underside to the foot of the body."""
    if p.foot > 0:  # narrowed to a base ring
        stand = body - p.foot
        hollow = (
            [(0.0, p.dome), (0.6 * stand, 0.8 * p.dome), (stand - 0.004, 0.0)] if p.dome > 0 else [(0.0, 0.0)]
        )
        return np.array([*hollow, (stand, 0.0), (stand, 0.0025), (body, 0.0025 + 1.1 * p.foot)])
    if p.kind == "food" or p.bend > 0:
        seam = p.radius
        hollow = [(0.0, p.recess), (seam - 0.003, p.recess), (seam - 0.003, 0.0)]
        return np.array([*hollow, (seam, 0.0), (seam, p.rim), (body, p.rim + p.seam)])
    return np.array([(0.0, 0.0), (body, 0.0)])


def _top(p: CanParameters, body: float) -> Curve:
    """Return the profile from the top of the body over rim or lid to the axis."""
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
    """Sample a can of the split's families."""
    kind: CanKind = rng.choice(KINDS[split])
    radius = rng.uniform(0.024, WIDEST)
    height = float(np.clip(2.0 * radius * rng.uniform(0.9, 2.9), 0.060, 0.170))
    necked = kind == "drink"
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
        foot=float(rng.uniform(*FOOT)) if necked else 0.0,
        bend=float(rng.uniform(*BENDS[kind])) if kind in BENDS else 0.0,
        density=float(rng.uniform(350.0, 1050.0)),
    )
