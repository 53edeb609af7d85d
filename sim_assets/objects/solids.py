"""Solids of the object families: a body of revolution, and a swept handle outside its core.

Inside test, bounding box and surface mesh derive from the same curves. Object frame: z up,
base on z = 0, axis x = y = 0, handle along +x; [m].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from sim_assets.objects.profiles import Curve, inside_profile, radial_crossings, smoothstep

AROUND = 80  # vertices on a ring of a visual mesh
HANDLE_AROUND = 24  # vertices around a handle's section


def closed_tube(
    rings: Float[np.ndarray, "k n 3"], first: tuple[float, float, float], last: tuple[float, float, float]
) -> trimesh.Trimesh:
    """Triangulate between successive rings (anticlockwise seen from `last`), with fans from the ends."""
    count, around = rings.shape[:2]
    here = np.arange(around)
    ahead = np.roll(here, -1)
    level = around * np.arange(count - 1)[:, None]
    a, b, c, d = (level + part for part in (here, ahead, ahead + around, here + around))
    sides = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).reshape(-1, 3)
    pole_first, pole_last, top = count * around, count * around + 1, (count - 1) * around
    fan_first = np.stack([ahead, here, np.full(around, pole_first)], axis=-1)
    fan_last = np.stack([top + here, top + ahead, np.full(around, pole_last)], axis=-1)
    vertices = np.concatenate([rings.reshape(-1, 3), [first, last]])
    return trimesh.Trimesh(vertices, np.concatenate([sides, fan_first, fan_last]), process=False)


@runtime_checkable
class Section(Protocol):
    """Horizontal section of a body that is not round, symmetric about the planes x = 0 and y = 0.

    The radius at azimuth θ is the profile's times 1 + w(z) (m(θ) - 1), with m(0) = 1.
    """

    @property
    def aspect(self) -> float:
        """Extent along y over the extent along x."""
        ...

    def modulation(self, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
        """Return m(θ) - 1, any shape."""
        ...

    def weight(self, z: np.ndarray) -> np.ndarray:
        """Return w(z), any shape."""
        ...


@dataclass(frozen=True)
class SuperellipseSection:
    """A superellipse that changes into a circle at the neck.

    m(θ) = (|cos θ|ⁿ + |sin θ / aspect|ⁿ)^(-1/n), and w falls from 1 at z_section to 0 at z_round.
    """

    aspect: float
    exponent: float
    z_section: float
    z_round: float

    def modulation(self, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
        """Return m(θ) - 1, any shape."""
        n = self.exponent
        return (np.abs(cos) ** n + np.abs(sin / self.aspect) ** n) ** (-1.0 / n) - 1.0

    def weight(self, z: np.ndarray) -> np.ndarray:
        """Return w(z), any shape."""
        return 1.0 - smoothstep((z - self.z_section) / max(self.z_round - self.z_section, 1e-6))


@dataclass(frozen=True)
class PolygonSection:
    """A regular polygon at all heights, a corner on +x: m(θ) = cos(π/n) / cos(φ), φ from the facet's middle.

    The number of corners n is a multiple of four, so that corners lie on both axes.
    """

    corners: int

    @property
    def aspect(self) -> float:
        return 1.0

    def modulation(self, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
        """Return m(θ) - 1, any shape."""
        facet = 2.0 * np.pi / self.corners
        from_middle = np.arctan2(sin, cos) % facet - 0.5 * facet
        return np.cos(0.5 * facet) / np.cos(from_middle) - 1.0

    def weight(self, z: np.ndarray) -> np.ndarray:
        """Return 1 at all heights."""
        return np.ones_like(z)


@dataclass(frozen=True)
class LobedSection:
    """A wavy circle at all heights, a lobe on +x: m(θ) = 1 - depth (1 - cos nθ) / 2.

    The number of lobes n is a multiple of four, so that lobes lie on both axes.
    """

    lobes: int
    depth: float

    @property
    def aspect(self) -> float:
        return 1.0

    def modulation(self, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
        """Return m(θ) - 1, any shape."""
        return -0.5 * self.depth * (1.0 - np.cos(self.lobes * np.arctan2(sin, cos)))

    def weight(self, z: np.ndarray) -> np.ndarray:
        """Return 1 at all heights."""
        return np.ones_like(z)


@dataclass(frozen=True)
class Lathe:
    """A body of revolution of a profile, with a circular or other section."""

    profile: Curve
    section: Section | None = None

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        r = np.hypot(points[:, 0], points[:, 1])
        if self.section is not None:
            safe = np.maximum(r, 1e-12)
            modulation = self.section.modulation(points[:, 0] / safe, points[:, 1] / safe)
            r = r / (1.0 + self.section.weight(points[:, 2]) * modulation)
        return inside_profile(self.profile, r, points[:, 2])

    @cached_property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Corners of the bounding box. Half-width along y as the profile's times 1 + w (aspect - 1)."""
        r, z = self.profile.T
        ry = r if self.section is None else r * (1.0 + self.section.weight(z) * (self.section.aspect - 1.0))
        return np.array([[-r.max(), -ry.max(), z.min()], [r.max(), ry.max(), z.max()]])

    def mesh(self, around: int = AROUND) -> trimesh.Trimesh:
        """Watertight surface: a ring of vertices for each profile point off the axis, two poles."""
        angle = 2 * np.pi * np.arange(around) / around
        r, z = self.profile[1:-1, :1], self.profile[1:-1, 1:]
        if self.section is not None:
            modulation = self.section.modulation(np.cos(angle), np.sin(angle))
            r = r * (1.0 + self.section.weight(z) * modulation)
        r, z = np.broadcast_arrays(r, z + 0 * angle)
        r = np.broadcast_to(r, z.shape)
        rings = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)  # (rings, around, 3)
        bottom, top = (0.0, 0.0, self.profile[0, 1]), (0.0, 0.0, self.profile[-1, 1])
        return closed_tube(rings, bottom, top)


@dataclass(frozen=True)
class Handle:
    """A section swept along a curve in the plane y = 0.

    Attributes:
        centreline: (k, 2) curve in (x, z) [m].
        thickness: (k,) half the thickness in the plane [m].
        width: (k,) half the width along y [m].
        exponent: exponent of the superelliptic section: 2 for an ellipse, more for a strap.
    """

    centreline: Curve
    thickness: Float[np.ndarray, "k"]
    width: Float[np.ndarray, "k"]
    exponent: float

    def half_width(self, x: Float[np.ndarray, "n"], z: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the half width of the handle along y at points (x, z) [m]; 0 outside its silhouette.

        The centreline is sampled densely: the nearest segment starts or ends at the nearest point.
        """
        points = np.stack([x, z], axis=1)
        last = len(self.centreline) - 1
        reach = self.thickness.max() + np.hypot(*np.diff(self.centreline, axis=0).T).max()
        nearest = np.asarray(self._tree.query(points, distance_upper_bound=reach)[1])
        result = np.zeros(len(x))
        near = np.flatnonzero(nearest <= last)  # KDTree marks misses with the number of its points
        points, nearest = points[near], nearest[near]
        best, at = np.full(len(near), np.inf), np.zeros(len(near))
        for first in (np.maximum(nearest - 1, 0), np.minimum(nearest, last - 1)):
            start, step = self.centreline[first], self.centreline[first + 1] - self.centreline[first]
            offset = points - start
            along = np.clip((offset * step).sum(axis=1) / (step**2).sum(axis=1), 0.0, 1.0)
            distance = np.linalg.norm(offset - along[:, None] * step, axis=1)
            at = np.where(distance < best, first + along, at)
            best = np.minimum(distance, best)
        knots = np.arange(last + 1)
        ratio = best / np.interp(at, knots, self.thickness)
        room = np.maximum(1.0 - ratio**self.exponent, 0.0)
        result[near] = np.interp(at, knots, self.width) * room ** (1.0 / self.exponent)
        return result

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.centreline)

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        inside = np.zeros(len(points), dtype=bool)
        low, high = self.outline.min(axis=0), self.outline.max(axis=0)
        near = np.flatnonzero(((points[:, [0, 2]] >= low) & (points[:, [0, 2]] <= high)).all(axis=1))
        inside[near] = np.abs(points[near, 1]) < self.half_width(points[near, 0], points[near, 2])
        return inside

    @cached_property
    def normals(self) -> Curve:
        """Return (k, 2) unit normals of the centreline in its plane."""
        tangent = np.gradient(self.centreline, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        return np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)

    @cached_property
    def outline(self) -> Curve:
        """Return the (2k, 2) silhouette in the plane y = 0."""
        offset = self.normals * self.thickness[:, None]
        return np.concatenate([self.centreline + offset, self.centreline - offset])

    def mesh(self, around: int = HANDLE_AROUND) -> trimesh.Trimesh:
        """Return the watertight sweep with flat ends (inside the body's wall)."""
        angle = 2 * np.pi * np.arange(around) / around
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        unit = np.sign(unit) * np.abs(unit) ** (2.0 / self.exponent)
        in_plane = self.centreline[:, None] + self.normals[:, None] * (
            self.thickness[:, None, None] * unit[None, :, :1]
        )
        y = -self.width[:, None] * unit[:, 1]  # normal, -y and tangent are right-handed
        rings = np.stack([in_plane[..., 0], y, in_plane[..., 1]], axis=-1)
        ends = self.centreline[[0, -1]]
        return closed_tube(rings, (ends[0, 0], 0.0, ends[0, 1]), (ends[1, 0], 0.0, ends[1, 1]))


@dataclass(frozen=True)
class Solid:
    """A body, and for mugs a handle outside the body's core.

    `core` is a curve from the axis up along the middle of the wall: the handle is cut off there, so that it
    ends inside the wall and does not enter the cavity.
    """

    body: Lathe
    handle: Handle | None = None
    core: Curve | None = None

    def core_radius(self, z: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the radius within which the handle is cut off; above the rim, that of the rim."""
        assert self.core is not None
        radius = np.interp(z, self.core[:, 1], self.core[:, 0])
        return np.where(z < self.core[0, 1], 0.0, radius)

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which points of the object frame are inside the material."""
        inside = self.body.inside(points)
        if self.handle is not None:
            outside_core = np.hypot(points[:, 0], points[:, 1]) > self.core_radius(points[:, 2])
            inside |= outside_core & self.handle.inside(points)
        return inside

    def is_handle(self, points: Float[np.ndarray, "n 3"], margin: float = 5e-4) -> Bool[np.ndarray, "n"]:
        """Return which surface points belong to the handle: on it, and 1 mm clear of the body."""
        if self.handle is None:
            return np.zeros(len(points), dtype=bool)
        swollen = Handle(
            self.handle.centreline,
            self.handle.thickness + margin,
            self.handle.width + margin,
            self.handle.exponent,
        )
        r = np.hypot(points[:, 0], points[:, 1])
        return swollen.inside(points) & (points[:, 0] > 0) & (r > self._outer_radius(points[:, 2]) + 1e-3)

    def _outer_radius(self, z: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        crossings = radial_crossings(self.body.profile, z)
        return crossings[:, 0] if crossings.shape[1] else np.zeros(len(z))

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """(2, 3) corners of the bounding box [m]."""
        bounds = self.body.bounds.copy()
        if self.handle is not None:
            bounds[1, 0] = max(bounds[1, 0], self.handle.outline[:, 0].max())
            bounds[0, 2] = min(bounds[0, 2], self.handle.outline[:, 1].min())
            bounds[1, 2] = max(bounds[1, 2], self.handle.outline[:, 1].max())
        return bounds

    def mesh(self) -> trimesh.Trimesh:
        """Watertight outer surface, cavity included."""
        mesh = self.body.mesh()
        if self.handle is not None:
            assert self.core is not None
            lid = self.core[-1] + (0.0, 0.1)
            core = Lathe(np.concatenate([[(0.0, self.core[0, 1])], self.core, [lid], [(0.0, lid[1])]]))
            handle = trimesh.boolean.difference([self.handle.mesh(), core.mesh()], engine="manifold")
            mesh = trimesh.boolean.union([mesh, handle], engine="manifold")
        return mesh
