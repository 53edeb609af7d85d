"""Success criteria of packing and sorting, evaluated on true poses and shapes.

Pack: every object upright (tilt < 10 degrees) and fully inside the box, bowls nested with the largest lowest,
mugs' centres in line, their handles within 15 degrees of each other, nothing toppled or off the table.
Sort: all objects upright on one line (within 2 cm of it), ascending by true size; where two differ by less
than 3 mm either order counts. An object whose two ends are alike, such as most cans, is upright on either.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from app.task.bowl_nesting import min_nests, radial_envelope
from perception.metrics import SurfaceSamples
from perception.types import Category, TriangleMesh, profile_size

LIKE_ENDS = 0.003  # [m] largest distance between an object and itself turned over, if its ends are alike
_SAMPLES = 20000  # of a surface, 1 mm apart
_SHARE = 0.99  # of the samples that are compared


@dataclass(frozen=True)
class Criteria:
    """Tolerances of the success criteria.

    Attributes:
        tilt: Largest angle between an object's axis and the vertical, in radians.
        inside: Largest penetration of the box walls in metres: contacts are soft.
        standing: Largest height of a base above the floor of the box outside a nest, in metres.
        mug_line: Largest distance of a mug's axis from the line through all mugs, in metres.
        handles: Largest angle between the directions of two handles, in radians.
        nest: Largest distance between the axes of nested bowls, in metres.
        must_nest: Largest resting lift, as a share of the lower bowl's height, at which bowls must be nested.
        may_nest: Largest lift, as a share of the lower bowl's height, at which a nested bowl is seated.
        same_size: Difference in size below which either order is accepted, in metres.
        line: Largest distance of a sorted object's axis from the line, in metres.
    """

    tilt: float = np.deg2rad(10.0)
    inside: float = 0.002
    standing: float = 0.015
    mug_line: float = 0.02
    handles: float = np.deg2rad(15.0)
    nest: float = 0.03
    must_nest: float = 0.6
    may_nest: float = 0.8
    same_size: float = 0.003
    line: float = 0.02


@dataclass(frozen=True)
class TrueObject:
    """True shape and pose of an object.

    Attributes:
        category: Class.
        vertices: Surface in the object frame in metres: base at z = 0, axis at x = y = 0, handle along +x.
        faces: Vertex indices of the triangles.
        height, radius: As defined by ``ObjectEstimate``, in metres.
        T_world_object: Pose.
    """

    category: Category
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    height: float
    radius: float
    T_world_object: Float[np.ndarray, "4 4"]

    @property
    def size(self) -> float:
        return profile_size(self.height, self.radius)

    @property
    def tilt(self) -> float:
        """Angle between the object's axis and the vertical, in radians."""
        return float(np.arccos(np.clip(self.T_world_object[2, 2], -1, 1)))

    @property
    def yaw(self) -> float:
        """Direction of the handle about the vertical, in radians."""
        return float(np.arctan2(self.T_world_object[1, 0], self.T_world_object[0, 0]))

    @property
    def base(self) -> Float[np.ndarray, "3"]:
        """Centre of the base in the world frame, in metres."""
        return self.T_world_object[:3, 3]

    def on_like_end(self) -> TrueObject:
        """Return the object turned over about its middle if it stands on its top and its ends are alike."""
        if self.T_world_object[2, 2] > -np.sqrt(0.5) or not self._has_like_ends():
            return self
        return replace(self, T_world_object=self.T_world_object @ self._turn())

    def _turn(self) -> Float[np.ndarray, "4 4"]:
        """Return the half turn about the x axis at half the object's extent along z."""
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[2, 3] = self.vertices[:, 2].min() + self.vertices[:, 2].max()
        return T

    def _has_like_ends(self) -> bool:
        """Return whether the surface coincides with itself turned over."""
        mesh = TriangleMesh(self.vertices, self.faces)
        points = SurfaceSamples.of(mesh, np.random.default_rng(0), _SAMPLES).points
        turned = points @ self._turn()[:3, :3].T + self._turn()[:3, 3]
        distance = KDTree(points).query(turned)[0]
        return bool(np.quantile(distance, _SHARE) < LIKE_ENDS)

    @property
    def vertices_world(self) -> Float[np.ndarray, "v 3"]:
        return self.vertices @ self.T_world_object[:3, :3].T + self.T_world_object[:3, 3]


@dataclass(frozen=True)
class BoxSpace:
    """Interior of the box: centre (x, y), inner length and width, height of the floor, in metres."""

    center: tuple[float, float]
    size: tuple[float, float]
    floor: float


def judge_standing(objects: Sequence[TrueObject], criteria: Criteria = Criteria()) -> list[str]:
    """Return for each object the reason why it does not stand upright, or an empty string."""
    reasons = []
    for item in objects:
        if item.base[2] < -0.05:
            reasons.append("fell off the table")
        elif item.tilt > criteria.tilt:
            toppled = item.tilt > np.deg2rad(45)
            reasons.append(f"{'toppled' if toppled else 'tilted'} by {np.rad2deg(item.tilt):.0f} deg")
        else:
            reasons.append("")
    return reasons


def judge_pack(objects: Sequence[TrueObject], box: BoxSpace, criteria: Criteria = Criteria()) -> list[str]:
    """Return for each object the reason why it is not packed correctly, or an empty string.

    The bowls may form as many nests as their true shapes require; a resting lift between ``must_nest`` and
    ``may_nest`` neither requires a nest nor forbids it.
    """
    reasons = judge_standing(objects, criteria)
    for i, item in enumerate(objects):
        reasons[i] = reasons[i] or _outside(item, box, criteria)
    envelopes = [radial_envelope(item.vertices, item.faces) for item in objects if item.category == "bowl"]
    nests = min_nests(envelopes, criteria.must_nest)
    bowls = [i for i, item in enumerate(objects) if item.category == "bowl" and not reasons[i]]
    for i, reason in _judge_nests([objects[i] for i in bowls], box, nests, criteria).items():
        reasons[bowls[i]] = reason
    mugs = [i for i, item in enumerate(objects) if item.category == "mug" and not reasons[i]]
    for i, reason in _judge_row([objects[i] for i in mugs], criteria).items():
        reasons[mugs[i]] = reason
    return reasons


def judge_sort(
    objects: Sequence[TrueObject],
    lines: Sequence[tuple[tuple[float, float], tuple[float, float]]],
    criteria: Criteria = Criteria(),
) -> list[str]:
    """Return for each object the reason why it is not sorted, or an empty string.

    Args:
        objects: True states.
        lines: Ends (x, y) of each row in metres; sizes ascend from start to end and from row to row.
        criteria: Tolerances.
    """
    reasons = judge_standing(objects, criteria)
    rank: dict[int, tuple[int, float]] = {}
    for i, item in enumerate(objects):
        from_lines = [_along(item, *line) for line in lines]
        row = min(range(len(lines)), key=lambda k: from_lines[k][1])
        position, off = from_lines[row]
        rank[i] = (row, position)
        if not reasons[i] and off > criteria.line:
            reasons[i] = f"off the line by {100 * off:.1f} cm"
    on_line = sorted((i for i in rank if not reasons[i]), key=lambda i: rank[i])
    kept = _largest_ascending([objects[i].size for i in on_line], criteria.same_size)
    for place, i in enumerate(on_line):
        if place not in kept:
            reasons[i] = "out of order by size"
    return reasons


def _along(item: TrueObject, start: tuple[float, float], end: tuple[float, float]) -> tuple[float, float]:
    """Return the position of an object along a line and its distance from the segment's sides or ends [m]."""
    along = np.array(end) - np.array(start)
    length = float(np.linalg.norm(along))
    along = along / length
    offset = item.base[:2] - np.array(start)
    position = float(offset @ along)
    distance = abs(float(offset @ np.array([-along[1], along[0]])))
    return position, max(distance, -position, position - length)


def _outside(item: TrueObject, box: BoxSpace, criteria: Criteria) -> str:
    reach = np.abs(item.vertices_world[:, :2] - box.center).max(axis=0) - np.array(box.size) / 2
    if reach.max() > criteria.inside:
        return f"outside the box by {1000 * reach.max():.0f} mm"
    if item.category != "bowl" and item.base[2] > box.floor + criteria.standing:
        return f"not on the floor of the box but {1000 * (item.base[2] - box.floor):.0f} mm above"
    return ""


def _judge_nests(
    bowls: Sequence[TrueObject], box: BoxSpace, nests: int, criteria: Criteria
) -> dict[int, str]:
    """Return a reason for each bowl beside the nests, not seated in its nest, or above a smaller one."""
    wrong: dict[int, str] = {}
    for rank, nest in enumerate(_nests(bowls, criteria.nest)):
        if rank >= nests:
            wrong |= dict.fromkeys(nest, "bowl beside the nest")
            continue
        if bowls[nest[0]].base[2] > box.floor + criteria.standing:
            wrong[nest[0]] = "bowl on something that is no bowl"
        for below, above in pairwise(nest):
            lift = bowls[above].base[2] - bowls[below].base[2]
            if lift > criteria.may_nest * bowls[below].height:
                wrong[above] = f"bowl not seated in the nest but {1000 * lift:.0f} mm above the bowl beneath"
        kept = _largest_ascending([-bowls[i].radius for i in nest], criteria.same_size)
        for position, i in enumerate(nest):
            if position not in kept:
                wrong.setdefault(i, "bowl nested in the wrong order")
    return wrong


def _nests(bowls: Sequence[TrueObject], distance: float) -> list[list[int]]:
    """Return groups of bowls with a common axis, each from the lowest up, the largest group first."""
    free, groups = set(range(len(bowls))), []
    while free:
        around = {
            i: [j for j in free if np.linalg.norm((bowls[i].base - bowls[j].base)[:2]) <= distance]
            for i in sorted(free)
        }
        group = max(around.values(), key=len)
        groups.append(sorted(group, key=lambda i: bowls[i].base[2]))
        free -= set(group)
    return groups


def _judge_row(mugs: Sequence[TrueObject], criteria: Criteria) -> dict[int, str]:
    """Return a reason for each mug outside the largest group with parallel handles or outside the row."""
    wrong: dict[int, str] = {}
    if len(mugs) < 2:
        return wrong
    yaws = np.array([mug.yaw for mug in mugs])
    turn = np.abs((yaws[:, None] - yaws + np.pi) % (2 * np.pi) - np.pi)
    alike = _largest_subset(len(mugs), lambda group: turn[np.ix_(group, group)].max() <= criteria.handles)
    for i in set(range(len(mugs))) - set(alike):
        wrong[i] = f"handle {np.rad2deg(turn[i, list(alike)].max()):.0f} deg from the others'"
    centres = np.array([mug.base[:2] for mug in mugs])
    in_row = _largest_subset(
        len(mugs), lambda group: _line_distances(centres[list(group)]).max() <= criteria.mug_line
    )
    for i in set(range(len(mugs))) - set(in_row):
        wrong.setdefault(i, "mug out of the row of mugs")
    return wrong


def _line_distances(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Return the distances from the total least squares line through the points, in metres."""
    centred = points - points.mean(axis=0)
    normal = np.linalg.svd(centred, full_matrices=True)[2][1]
    return np.abs(centred @ normal)


def _largest_ascending(sizes: Sequence[float], tolerance: float) -> tuple[int, ...]:
    """Return the largest subset in which no size follows one that is larger by the tolerance or more."""
    return _largest_subset(
        len(sizes),
        lambda group: all(sizes[a] < sizes[b] + tolerance for a, b in combinations(group, 2)),
    )


def _largest_subset(count: int, accepted: Callable[[tuple[int, ...]], bool]) -> tuple[int, ...]:
    """Return the first of the largest accepted subsets of ``range(count)``."""
    for size in range(count, 1, -1):
        for group in combinations(range(count), size):
            if accepted(group):
                return group
    return tuple(range(min(count, 1)))
