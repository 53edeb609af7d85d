"""Open vessels: a wall offset inwards from a side curve, a floor, a rounded rim, a base or foot ring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sim_assets.objects.profiles import Curve, soften, without_repeats
from sim_assets.objects.solids import Lathe

RIM_SEGMENTS = 8


@dataclass(frozen=True)
class Wall:
    """Thicknesses and fillets of a vessel in [m].

    Attributes:
        base: wall thickness low on the side.
        rim: wall thickness at the rim.
        floor: thickness of the floor, above the foot.
        base_fillet: radius of the outer fillet between side and base.
        inner_fillet: radius of the inner fillet between side and floor.
        foot_height: height of the foot under the side curve; 0 for none.
        foot_ring: radial width of the foot ring; 0 for a solid disc.
    """

    base: float
    rim: float
    floor: float
    base_fillet: float = 0.0
    inner_fillet: float = 0.0
    foot_height: float = 0.0
    foot_ring: float = 0.0


@dataclass(frozen=True)
class Vessel:
    """A hollow body of revolution; `outer` and `inner` are curves (r, z) from base and floor to the rim."""

    outer: Curve
    inner: Curve
    profile: Curve

    @property
    def floor(self) -> float:
        """Height of the cavity's floor [m]."""
        return float(self.inner[0, 1])

    @property
    def height(self) -> float:
        return float(self.outer[-1, 1])

    @property
    def radius(self) -> float:
        return float(self.profile[:, 0].max())

    def outer_radius(self, z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return np.interp(z, self.outer[:, 1], self.outer[:, 0])

    def inner_radius(self, z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return np.interp(z, self.inner[:, 1], self.inner[:, 0])

    @property
    def lathe(self) -> Lathe:
        return Lathe(self.profile)

    @property
    def core(self) -> Curve:
        """Return the middle of the wall from the floor to the rim, where handles end."""
        z = self.inner[:, 1]
        return np.stack([0.5 * (self.inner_radius(z) + self.outer_radius(z)), z], axis=1)


def make_vessel(side: Curve, height: float, wall: Wall) -> Vessel:
    """Build a vessel of a given total height.

    Args:
        side: (k, 2) outer curve (r, z), z rising from 0 at the base (or at the top of the foot).
        height: total height [m]; the curve is scaled along z to match it.
        wall: thicknesses and fillets.
    """
    side = without_repeats(side)
    along = np.linspace(0.0, 1.0, len(side))[:, None]
    tangent = np.gradient(side, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    inwards = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    offset = side + (wall.base + along * (wall.rim - wall.base)) * inwards

    rim_outer, rim_inner = _rim(side[-1], offset[-1], tangent[-1])
    outer = np.concatenate([side[:-1], rim_outer])
    inner = np.concatenate([offset[:-1], rim_inner])
    outer = _rising(outer)
    stretch = (height - wall.foot_height) / outer[:, 1].max()
    outer[:, 1] *= stretch
    inner = _from_floor(_rising(inner * (1.0, stretch)), wall.floor, wall.inner_fillet)
    outer[:, 0] -= _quarter_round(outer[:, 1], wall.base_fillet)
    foot = _foot(float(outer[0, 0]), wall)
    up = np.array([0.0, wall.foot_height])
    outer, inner = outer + up, inner + up
    profile = np.concatenate([foot, outer, inner[::-1], [(0.0, inner[0, 1])]])
    profile = soften(profile, 0.35 * min(wall.base, wall.rim), angle=0.6)
    if wall.foot_height > 0:
        outer = np.concatenate([[(outer[0, 0], 0.0)], outer])
    return Vessel(_rising(outer), inner, profile)


def _rim(outside: np.ndarray, inside: np.ndarray, tangent: np.ndarray) -> tuple[Curve, Curve]:
    """Return the two halves of a half circle over the end of the wall; both end at its highest point."""
    middle, across = 0.5 * (outside + inside), 0.5 * (outside - inside)
    angle = np.linspace(0.0, np.pi, 2 * RIM_SEGMENTS + 1)[:, None]
    arc = middle + np.cos(angle) * across + np.sin(angle) * tangent * np.linalg.norm(across)
    top = int(arc[:, 1].argmax())
    return arc[: top + 1], arc[top:][::-1]


def _rising(curve: Curve) -> Curve:
    """Return the points of a curve above all points before them, which removes folds of offset curves."""
    z = curve[:, 1]
    before = np.concatenate([[-np.inf], np.maximum.accumulate(z)[:-1]])
    return curve[z > before + 1e-7]


def _from_floor(inner: Curve, floor: float, radius: float) -> Curve:
    """Return the inner curve cut at the floor, with a rounded corner."""
    r_floor = max(float(np.interp(floor, inner[:, 1], inner[:, 0])), 1e-3)
    radius = min(radius, 0.8 * r_floor)
    corner = floor + radius * (1.0 - np.cos(np.linspace(0.0, np.pi / 2, 9)[:-1]))
    z = np.unique(np.concatenate([corner, inner[inner[:, 1] > floor + 1e-5, 1]]))
    r = np.interp(z, inner[:, 1], inner[:, 0])
    return np.stack([np.maximum(r - _quarter_round(z - floor, radius), 5e-4), z], axis=1)


def _quarter_round(z: np.ndarray, radius: float) -> np.ndarray:
    """Return the inset at height z of a convex fillet between vertical wall and horizontal base."""
    rest = np.clip(radius - z, 0.0, radius)
    return radius - np.sqrt(np.maximum(radius**2 - rest**2, 0.0))


def _foot(radius: float, wall: Wall) -> Curve:
    """Return the underside from the axis outwards to the start of the side curve."""
    if wall.foot_height <= 0:
        return np.array([(0.0, 0.0)])
    if wall.foot_ring <= 0 or wall.foot_ring > 0.6 * radius:
        return np.array([(0.0, 0.0), (radius, 0.0)])
    hollow = radius - wall.foot_ring
    return np.array(
        [(0.0, 0.8 * wall.foot_height), (hollow, 0.8 * wall.foot_height), (hollow, 0.0), (radius, 0.0)]
    )
