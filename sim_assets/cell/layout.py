"""Random collision-free layouts on the table, from the true horizontal outlines of the objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from perception.geometry import pose_from_yaw
from sim_assets.cell.outlines import contains, distances_to, gap, outline
from sim_assets.errors import SimAssetsError

LIFT = 0.0005  # height above its resting pose at which an object starts [m]
TOUCHING = 0.0004  # distance between objects that are drawn together without a gap [m]
LOOSE_ATTEMPTS = 10  # restarts with candidates in random order


class LayoutError(SimAssetsError, ValueError):
    """The objects do not fit; the message gives the largest number placed."""


class ArrangementError(LayoutError):
    """Too few of the objects rest in a pose.

    Attributes:
        pose: "lying", "upside_down" or "stacked".
    """

    def __init__(self, pose: str, wanted: int, found: int) -> None:
        what = "stand on others" if pose == "stacked" else "rest that way"
        option = f"--{pose.replace('_', '-')} {wanted}"
        super().__init__(f"{option}: only {found} of these objects {what}; use other or more objects")
        self.pose = pose


class UnstableError(LayoutError):
    """A body does not rest in any layout.

    Attributes:
        body: its name.
    """

    def __init__(self, message: str, body: str) -> None:
        super().__init__(message)
        self.body = body


@dataclass(frozen=True)
class Region:
    """Region of object centres in [m]: a rectangle within ``max_radius`` of the robot's base."""

    x: tuple[float, float] = (0.30, 0.62)
    y: tuple[float, float] = (-0.50, -0.05)
    max_radius: float = 0.70

    def scaled(self, scale: float) -> Region:
        """Return the similar region about the base."""
        x, y = (tuple(scale * value for value in limits) for limits in (self.x, self.y))
        return Region((x[0], x[1]), (y[0], y[1]), scale * self.max_radius)


WIDE_REGION = Region(x=(0.28, 0.65), y=(-0.53, -0.03), max_radius=0.75)  # what the arm still reaches


@dataclass(frozen=True)
class PlanarPose:
    """Pose of an upright object on the table: position in [m], yaw about z in [rad]."""

    x: float
    y: float
    yaw: float

    def transform(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Transform points of the object frame to the world."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return points @ np.array([[c, s], [-s, c]]) + (self.x, self.y)

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """(4, 4) T_world_object."""
        return pose_from_yaw(self.yaw, np.array([self.x, self.y, 0.0]))

    @property
    def position(self) -> tuple[float, float, float]:
        """Position just above the table in [m]."""
        return (self.x, self.y, LIFT)

    @property
    def quat_wxyz(self) -> tuple[float, float, float, float]:
        """Orientation as a quaternion."""
        return quat_from_yaw(self.yaw)


@dataclass(frozen=True)
class FreePose:
    """Pose of an object in any orientation: position in [m], quaternion wxyz."""

    position: tuple[float, float, float]
    quat_wxyz: tuple[float, float, float, float]

    @classmethod
    def of(cls, T_world_object: Float[np.ndarray, "4 4"]) -> FreePose:
        """Return the pose of a matrix."""
        x, y, z = (float(value) for value in T_world_object[:3, 3])
        w, i, j, k = Rotation.from_matrix(T_world_object[:3, :3]).as_quat(scalar_first=True).tolist()
        return cls((x, y, z + LIFT), (w, i, j, k))


def quat_from_yaw(yaw: float) -> tuple[float, float, float, float]:
    """Return the quaternion wxyz of a rotation about z by ``yaw`` [rad]."""
    return (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))


@dataclass(frozen=True)
class _Footprint:
    """An outline with its circumscribed and inscribed circles about the origin."""

    outline: Float[np.ndarray, "n 2"]
    outer: float
    inner: float

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> _Footprint:
        polygon = outline(mesh)
        edges = distances_to(np.zeros((1, 2)), polygon)
        inner = float(edges.min()) if contains(polygon, np.zeros(2)) else 0.0
        return cls(polygon, float(np.linalg.norm(polygon, axis=1).max()), inner)


def sample_layout(
    meshes: Sequence[trimesh.Trimesh],
    rng: np.random.Generator,
    region: Region | None = None,
    min_gap: float = 0.04,
    restarts: int = 60,
    tries: int = 200,
) -> tuple[PlanarPose, ...]:
    """Place upright objects at random, at any yaw, with at least ``min_gap`` [m] between their outlines.

    Objects are placed one by one, the widest first, each at the first free candidate; if there is
    none, the layout restarts. After LOOSE_ATTEMPTS restarts, candidates are tried from one side of the table
    to the other.

    Args:
        meshes: object meshes, z up, standing on z = 0.
        restarts, tries: number of layouts started, and of candidates per object.

    Raises:
        LayoutError: no layout was found.
    """
    min_gap = max(min_gap, TOUCHING)  # the gap of overlapping outlines is 0 as well
    footprints = [_Footprint.of(mesh) for mesh in meshes]
    order = sorted(range(len(meshes)), key=lambda i: -footprints[i].outer)
    most = 0
    for attempt in range(restarts):
        placed: dict[int, PlanarPose] = {}
        angle = rng.uniform(-np.pi, np.pi)
        toward = np.array([np.cos(angle), np.sin(angle)])
        for index in order:
            others = [(footprints[i], pose) for i, pose in placed.items()]
            candidates = _candidates(rng, region or Region(), tries)
            if attempt >= LOOSE_ATTEMPTS:
                candidates = candidates[np.argsort(candidates[:, :2] @ toward)]
            pose = _free_place(footprints[index], candidates, others, min_gap)
            if pose is None:
                break
            placed[index] = pose
        else:
            return tuple(placed[i] for i in range(len(meshes)))
        most = max(most, len(placed))
    raise LayoutError(
        f"{len(meshes)} objects do not fit on the table with {1000 * min_gap:.0f} mm between them: "
        f"at most {most} were placed in {restarts} attempts; use fewer or smaller objects, or a smaller gap"
    )


def sample_roomy_layout(
    meshes: Sequence[trimesh.Trimesh],
    rng: np.random.Generator,
    region: Region,
    min_gap: float = 0.04,
    scale: float = 1.0,
) -> tuple[PlanarPose, ...]:
    """Return a layout within the region; if there is none and it is the default one, within WIDE_REGION.

    Of a cell of another scale, both are scaled; other regions are not.

    Raises:
        LayoutError: no layout was found.
    """
    if region != Region():
        return sample_layout(meshes, rng, region, min_gap)
    try:
        return sample_layout(meshes, rng, region.scaled(scale), min_gap)
    except LayoutError:
        return sample_layout(meshes, rng, WIDE_REGION.scaled(scale), min_gap)


def draw_together(
    meshes: Sequence[trimesh.Trimesh], poses: Sequence[PlanarPose], spacing: float
) -> tuple[PlanarPose, ...]:
    """Return the layout with objects moved straight towards their nearest neighbours, to ``spacing`` [m].

    Every object but the first of each group moves, one after the other; the yaws remain. At least TOUCHING is
    kept, so that no two objects start inside each other.
    """
    spacing = max(spacing, TOUCHING)
    outlines = [outline(mesh) for mesh in meshes]
    moved = list(poses)
    still: set[int] = set()  # neighbours that others have moved to
    for i in range(len(moved)):
        if i in still or len(moved) < 2:
            continue
        there = [pose.transform(polygon) for pose, polygon in zip(moved, outlines, strict=True)]
        nearest = min((j for j in range(len(moved)) if j != i), key=lambda j: gap(there[i], there[j]))
        others = [polygon for j, polygon in enumerate(there) if j != i]
        moved[i] = _moved_toward(moved[i], outlines[i], moved[nearest], others, spacing)
        still.add(nearest)
    return tuple(moved)


def _moved_toward(
    pose: PlanarPose,
    polygon: Float[np.ndarray, "n 2"],
    target: PlanarPose,
    others: Sequence[Float[np.ndarray, "_m 2"]],
    spacing: float,
) -> PlanarPose:
    """Return the pose on the way to the target at which the first of the others is ``spacing`` [m] away."""

    def at(share: float) -> PlanarPose:
        return PlanarPose(
            pose.x + share * (target.x - pose.x), pose.y + share * (target.y - pose.y), pose.yaw
        )

    def is_free(share: float) -> bool:
        there = at(share).transform(polygon)
        return all(gap(there, other) >= spacing for other in others)

    length = np.hypot(target.x - pose.x, target.y - pose.y)
    steps = np.arange(0.0, 1.0, 0.004 / max(length, 0.004))
    free, blocked = 0.0, next((share for share in steps[1:] if not is_free(share)), 1.0)
    free = max((share for share in steps if share < blocked), default=0.0)
    while (blocked - free) * length > TOUCHING / 4:
        middle = (free + blocked) / 2
        free, blocked = (middle, blocked) if is_free(middle) else (free, middle)
    return at(float(free))


def _candidates(rng: np.random.Generator, region: Region, count: int) -> Float[np.ndarray, "n 3"]:
    """Sample (x, y, yaw) within the region."""
    low, high = (region.x[0], region.y[0], -np.pi), (region.x[1], region.y[1], np.pi)
    poses = rng.uniform(low, high, (count, 3))
    return poses[np.hypot(poses[:, 0], poses[:, 1]) <= region.max_radius]


def _free_place(
    footprint: _Footprint,
    candidates: Float[np.ndarray, "n 3"],
    placed: list[tuple[_Footprint, PlanarPose]],
    min_gap: float,
) -> PlanarPose | None:
    """Return the first collision-free candidate, None without one."""
    centers = np.array([(pose.x, pose.y) for _, pose in placed]).reshape(-1, 2)
    distance = np.linalg.norm(candidates[:, None, :2] - centers[None], axis=-1)  # (candidates, placed)
    inner = np.array([other.inner for other, _ in placed])
    outer = np.array([other.outer for other, _ in placed])
    possible = np.flatnonzero((distance > footprint.inner + inner + min_gap).all(axis=1))
    unsure = distance <= footprint.outer + outer + min_gap
    for row in possible:
        pose = PlanarPose(*(float(value) for value in candidates[row]))
        polygon = pose.transform(footprint.outline)
        near = (placed[i] for i in np.flatnonzero(unsure[row]))
        if all(gap(polygon, there.transform(other.outline)) >= min_gap for other, there in near):
            return pose
    return None
