"""Building blocks of distractors: primitives with texture coordinates, joined to things.

A primitive is mapped along its own faces when it is made, so that a print turns and tilts with its box.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import trimesh
from trimesh import creation
from trimesh.transformations import rotation_matrix

from sim_assets.rendering.texture_coordinates import ATTRIBUTE, CELLS, along_faces, in_cell

Mesh = trimesh.Trimesh
Point = tuple[float, float, float] | np.ndarray
PRINT = "print"  # surface with three cells: front, side and top of a package


def mapped(mesh: Mesh) -> Mesh:
    """Give a mesh texture coordinates in 0..1 along its present faces."""
    unit, axis = along_faces(mesh)
    mesh.face_attributes[ATTRIBUTE], mesh.face_attributes["axis"] = unit, axis
    return mesh


def box(size: Point, center: Point = (0, 0, 0), yaw: float = 0.0) -> Mesh:
    """Return a box about ``center``, turned about its own vertical axis."""
    mesh = mapped(creation.box(size))
    if yaw:
        mesh.apply_transform(rotation_matrix(yaw, (0, 0, 1)))
    mesh.apply_translation(center)
    return mesh


def ball(radius: float | Point, center: Point = (0, 0, 0), detail: int = 2) -> Mesh:
    """Return a ball, or an ellipsoid with three half-axes."""
    mesh = creation.icosphere(subdivisions=detail, radius=1.0)
    mesh.apply_scale(np.broadcast_to(radius, 3))
    mesh.apply_translation(center)
    return mapped(mesh)


def hull(points: np.ndarray) -> Mesh:
    """Return the convex hull."""
    return mapped(trimesh.convex.convex_hull(points))


def rounded_box(size: Point, radius: float, center: Point = (0, 0, 0)) -> Mesh:
    """Return a box with rounded vertical edges and slightly rounded horizontal ones."""
    x, y, z = (float(s) / 2 for s in size)
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False) + np.pi / 20
    corner = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rest = np.sign(corner) * (x - radius, y - radius)
    edge = min(0.35 * radius, 0.3 * z)
    rings = [(radius, z - edge), (radius - edge, z)]
    points = [np.column_stack([rest + r * corner, np.full(20, s * h)]) for r, h in rings for s in (-1, 1)]
    mesh = hull(np.concatenate(points))
    mesh.apply_translation(center)
    return mesh


def between(first: Point, last: Point, radius: float, around: int = 10) -> Mesh:
    """Return a rod with rounded ends between two points."""
    first, last = np.asarray(first, float), np.asarray(last, float)
    length = float(np.linalg.norm(last - first))
    mesh = creation.capsule(height=length, radius=radius, count=(around, max(6, around // 2)))
    mesh.apply_translation((0, 0, length / 2 - mesh.bounds[:, 2].mean()))
    mesh.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), (last - first) / max(length, 1e-9)))
    mesh.apply_translation(first)
    return mapped(mesh)


def cylinder(
    radius: float, height: float, center: Point = (0, 0, 0), axis: str = "z", around: int = 20
) -> Mesh:
    """Return a cylinder along an axis about ``center``."""
    mesh = creation.cylinder(radius=radius, height=height, sections=around)
    if axis != "z":
        mesh.apply_transform(rotation_matrix(np.pi / 2, (0, 1, 0) if axis == "x" else (1, 0, 0)))
    mesh.apply_translation(center)
    return mapped(mesh)


def lathe(profile: Sequence[Sequence[float] | np.ndarray] | np.ndarray, around: int = 28) -> Mesh:
    """Return the body of revolution of a profile (r, z)."""
    return _outwards(creation.revolve(np.asarray(profile, float), sections=around))


def tube(path: np.ndarray, radius: float | np.ndarray, around: int = 7) -> Mesh:
    """Return a tube of constant or varying radius along a (k, 3) path that is never upright for long."""
    path = np.asarray(path, float)
    along = np.gradient(path, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    aside = np.cross(along, (0.0137, 0.0291, 1.0))  # not parallel to any usual direction
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    up = np.cross(aside, along)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)[:, None]
    r = np.broadcast_to(radius, len(path))[:, None, None]
    rings = path[:, None] + r * (np.cos(angle) * aside[:, None] + np.sin(angle) * up[:, None])
    return loft(rings)


def loft(rings: np.ndarray) -> Mesh:
    """Return the closed surface through (k, n, 3) rings."""
    count, around = rings.shape[:2]
    here = np.arange(around)
    ahead = np.roll(here, -1)
    level = around * np.arange(count - 1)[:, None]
    a, b, c, d = (level + part for part in (here, ahead, ahead + around, here + around))
    sides = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).reshape(-1, 3)
    low, high = count * around, count * around + 1
    top = (count - 1) * around
    ends = np.concatenate(
        [
            np.stack([ahead, here, np.full(around, low)], axis=-1),
            np.stack([top + here, top + ahead, np.full(around, high)], axis=-1),
        ]
    )
    poles = np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    vertices = np.concatenate([rings.reshape(-1, 3), poles])
    return _outwards(Mesh(vertices, np.concatenate([sides, ends]), process=False))


def sheet(top: np.ndarray, thickness: float) -> Mesh:
    """Return the closed sheet below a (r, c, 3) grid of points."""
    rows, columns = top.shape[:2]
    bottom = top - (0, 0, thickness)
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    up = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    edge = np.concatenate([index[:, 0], index[-1, 1:], index[-2::-1, -1], index[0, -2:0:-1]])
    ahead, below = np.roll(edge, -1), rows * columns
    rim = np.concatenate(
        [np.stack([edge, edge + below, ahead], -1), np.stack([ahead, edge + below, ahead + below], -1)]
    )
    faces = np.concatenate([up, up[:, ::-1] + below, rim])
    return _outwards(Mesh(np.concatenate([top.reshape(-1, 3), bottom.reshape(-1, 3)]), faces, process=False))


def _outwards(mesh: Mesh) -> Mesh:
    """Map a closed surface after turning its normals outwards, whatever the order of its points."""
    if mesh.volume < 0:
        mesh.invert()
    return mapped(mesh)


def turned(mesh: Mesh, angle: float, axis: Point = (0, 0, 1), about: Point | None = None) -> Mesh:
    """Turn a mesh in place about an axis through a point (the origin) and return it."""
    mesh.apply_transform(rotation_matrix(angle, axis, about))
    return mesh


def moved(mesh: Mesh, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
    """Move a mesh in place and return it."""
    mesh.apply_translation((x, y, z))
    return mesh


def standing(mesh: Mesh) -> Mesh:
    """Move a mesh in place so that it stands on z = 0 with its middle over the origin, and return it."""
    x, y, _ = mesh.bounds.mean(axis=0)
    return moved(mesh, -x, -y, -mesh.bounds[0, 2])


def thing(*groups: tuple[str, Sequence[Mesh]]) -> Mesh:
    """Join groups of parts, each with the name of its surface, into one mesh; parts may overlap.

    The mesh's metadata has ``surfaces``: the name of the surface in each cell of its texture atlas.

    Raises:
        ValueError: more surfaces than cells.
    """
    surfaces: list[str] = []
    parts, coordinates = [], []
    for name, group in groups:
        first = len(surfaces)
        surfaces += [name] * (3 if name == PRINT else 1)
        for part in group:
            unit, axis = part.face_attributes[ATTRIBUTE], part.face_attributes["axis"]
            cells = axis + first if name == PRINT else np.full(len(axis), first)
            coordinates.append(in_cell(unit, cells))
            parts.append(part)
    if len(surfaces) > CELLS:
        raise ValueError(f"{len(surfaces)} surfaces, but an atlas has {CELLS} cells; join some: {surfaces}")
    mesh = Mesh(*_stacked(parts), process=False)
    mesh.face_attributes[ATTRIBUTE] = np.concatenate(coordinates)
    mesh.metadata["surfaces"] = tuple(surfaces)
    return mesh


def _stacked(parts: Sequence[Mesh]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices = np.concatenate([cast(np.ndarray, part.vertices) for part in parts])
    return vertices, np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
