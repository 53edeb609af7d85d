"""Things on a table top without physics: light meshes, coarse outlines, and free places for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Float

from perception.types import Category
from sim_assets.layout import PlanarPose, outline

OUTLINE_POINTS = 20
_TRIES = 30


@dataclass(frozen=True)
class Thing:
    """Something to put on the table.

    Attributes:
        category: its class; None for a thing of no class.
        mesh: z up, standing on z = 0, in [m].
        outline: (OUTLINE_POINTS, 2) points evenly along its horizontal outline.
        reach: largest distance of the outline from the origin.
    """

    category: Category | None
    mesh: trimesh.Trimesh
    outline: Float[np.ndarray, "n 2"]
    reach: float


def simplified(mesh: trimesh.Trimesh, tolerance: float = 0.00015) -> trimesh.Trimesh:
    """The same solid within ``tolerance`` [m], of far fewer triangles: they are what rendering here costs."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))
    )
    reduced = solid.simplify(tolerance).to_mesh()
    if len(reduced.tri_verts) == 0:  # a mesh file that is no solid
        return mesh
    return trimesh.Trimesh(reduced.vert_properties[:, :3], reduced.tri_verts, process=False)


def make_thing(category: Category | None, mesh: trimesh.Trimesh) -> Thing:
    """A thing with its outline sampled evenly."""
    polygon = outline(mesh)
    steps = np.cumsum(np.linalg.norm(np.diff(polygon, axis=0, append=polygon[:1]), axis=1))
    even = np.linspace(0, steps[-1], OUTLINE_POINTS, endpoint=False)
    closed, at = np.concatenate([polygon, polygon[:1]]), np.concatenate([[0], steps])
    points = np.stack([np.interp(even, at, closed[:, 0]), np.interp(even, at, closed[:, 1])], axis=1)
    return Thing(category, mesh, points, float(np.linalg.norm(points, axis=1).max()))


def scatter(
    things: Sequence[Thing], rng: np.random.Generator, gap: float, spread: float
) -> list[PlanarPose | None]:
    """A free place for each thing, None for one that found no room.

    Quick and coarse beside ``layout.sample_layout``: distances are those between sampled outlines.

    Args:
        gap: least distance between neighbours in [m].
        spread: half side of the square that they are put in, in [m].
    """
    poses: list[PlanarPose | None] = []
    taken: list[tuple[PlanarPose, float, np.ndarray]] = []
    for thing in things:
        poses.append(None)
        for _ in range(_TRIES):
            x, y = rng.uniform(-spread, spread, 2)
            pose = PlanarPose(x, y, rng.uniform(-np.pi, np.pi))
            points = pose.transform(thing.outline)
            if all(_apart(pose, thing.reach, points, *other, gap) for other in taken):
                poses[-1] = pose
                taken.append((pose, thing.reach, points))
                break
    return poses


def _apart(
    pose: PlanarPose,
    reach: float,
    points: np.ndarray,
    other: PlanarPose,
    other_reach: float,
    other_points: np.ndarray,
    gap: float,
) -> bool:
    """Whether two placed things keep their distance, centres first because that is cheap."""
    distance = np.hypot(pose.x - other.x, pose.y - other.y)
    if distance > reach + other_reach + gap:
        return True
    if distance < 0.6 * (reach + other_reach) - 0.02:
        return False
    sampling = 0.004  # what lies between the samples of an outline, about
    return bool(np.linalg.norm(points[:, None] - other_points, axis=-1).min() >= gap + sampling)
