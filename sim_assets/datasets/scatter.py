"""Random placement of items on a table top without physics: simplified meshes and outlines, free poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Float

from perception.types import Category, RestingPose
from sim_assets.cell.layout import PlanarPose
from sim_assets.cell.outlines import gap as gap_between
from sim_assets.cell.outlines import outline

OUTLINE_POINTS = 40
TOUCHING_GAP = 0.006  # [m], largest gap between touching neighbours
_TRIES = 30
_STEPS = 12  # towards a neighbour


@dataclass(frozen=True)
class TableItem:
    """An object or a distractor of a table-top scene.

    Attributes:
        category: class of the object; None for a distractor.
        mesh: z up, standing on z = 0, in [m].
        outline: (OUTLINE_POINTS, 2) evenly spaced points of the horizontal outline [m].
        reach: largest distance of the outline from the origin [m].
        content: what a vessel holds, in the same frame.
        ignored: whether it is an object in a pose whose class is not to be learned.
        resting: resting pose of an object.
    """

    category: Category | None
    mesh: trimesh.Trimesh
    outline: Float[np.ndarray, "n 2"]
    reach: float
    content: trimesh.Trimesh | None = None
    ignored: bool = False
    resting: RestingPose = "upright"


def simplified(mesh: trimesh.Trimesh, tolerance: float = 0.00015) -> trimesh.Trimesh:
    """Return the solid within ``tolerance`` [m] with fewer triangles, which dominate the rendering time."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))
    )
    reduced = solid.simplify(tolerance).to_mesh()
    if len(reduced.tri_verts) == 0:  # a mesh file that is not a solid
        return mesh
    return trimesh.Trimesh(reduced.vert_properties[:, :3], reduced.tri_verts, process=False)


def make_item(category: Category | None, mesh: trimesh.Trimesh) -> TableItem:
    """Return the item with its outline sampled evenly."""
    polygon = outline(mesh)
    steps = np.cumsum(np.linalg.norm(np.diff(polygon, axis=0, append=polygon[:1]), axis=1))
    even = np.linspace(0, steps[-1], OUTLINE_POINTS, endpoint=False)
    closed, at = np.concatenate([polygon, polygon[:1]]), np.concatenate([[0], steps])
    points = np.stack([np.interp(even, at, closed[:, 0]), np.interp(even, at, closed[:, 1])], axis=1)
    return TableItem(category, mesh, points, float(np.linalg.norm(points, axis=1).max()))


def scatter(
    items: Sequence[TableItem], rng: np.random.Generator, gap: float, spread: float, touching: float = 0.0
) -> list[PlanarPose | None]:
    """Sample a collision-free pose for each item, None for items without a free place.

    Faster and coarser than ``layout.sample_layout``: distances are those between sampled outlines.

    Args:
        gap: smallest distance between neighbours in [m].
        spread: half side of the square that contains the items, in [m].
        touching: share of the items pushed against a placed one, regardless of ``gap``.
    """
    poses: list[PlanarPose | None] = []
    taken: list[_Placed] = []
    for item in items:
        poses.append(None)
        beside = bool(taken) and rng.random() < touching
        for _ in range(_TRIES):
            if beside:
                pose = _pushed_against(item, taken[rng.integers(len(taken))], rng)
            else:
                x, y = rng.uniform(-spread, spread, 2)
                pose = PlanarPose(x, y, rng.uniform(-np.pi, np.pi))
            placed = _Placed(pose, item.reach, pose.transform(item.outline))
            if all(_apart(placed, other, 0.0 if beside else gap) for other in taken):
                poses[-1] = pose
                taken.append(placed)
                break
    return poses


@dataclass(frozen=True)
class _Placed:
    """Pose of a placed item and its outline there."""

    pose: PlanarPose
    reach: float
    outline: Float[np.ndarray, "n 2"]


def _pushed_against(item: TableItem, other: _Placed, rng: np.random.Generator) -> PlanarPose:
    """Return the pose of an item pushed towards another until the gap nearly closes."""
    direction, yaw = rng.uniform(-np.pi, np.pi, 2)
    left = rng.uniform(0, TOUCHING_GAP)
    away = np.array([np.cos(direction), np.sin(direction)])
    distance = item.reach + other.reach + TOUCHING_GAP
    for _ in range(_STEPS):
        x, y = distance * away + (other.pose.x, other.pose.y)
        pose = PlanarPose(x, y, yaw)
        excess = gap_between(pose.transform(item.outline), other.outline) - left
        if excess < 5e-4:
            break
        distance -= excess  # at most the gap's width, so that it cannot pass through
    return pose


def _apart(placed: _Placed, other: _Placed, gap: float) -> bool:
    """Return whether two placed items are at least ``gap`` apart, testing distances of the centres first."""
    distance = np.hypot(placed.pose.x - other.pose.x, placed.pose.y - other.pose.y)
    if distance > placed.reach + other.reach + gap:
        return True
    if distance < 0.6 * (placed.reach + other.reach) - 0.02:
        return False
    if gap == 0:
        return gap_between(placed.outline, other.outline) > 0
    nearest = np.linalg.norm(placed.outline[:, None] - other.outline, axis=-1).min()
    sampling = 0.002  # approximate error between the samples of an outline
    return bool(nearest >= gap + sampling)
