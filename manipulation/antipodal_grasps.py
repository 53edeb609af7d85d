"""Antipodal grasps of an object in any orientation: opposite places of its surface between the pads.

Two points p_i, p_j with outward normals n_i, n_j are antipodal if p_j is on the line from p_i into the
object, and n_j opposes n_i within twice the friction angle a:  -n_i.n_j > cos 2a. The pads close along the
mean of n_j and -n_i, which is then inside both friction cones. Walls, handles and whole bodies alike are
between such points. The hand may turn about that direction: of all approaches, those are kept at which the
hand is above every plane that the object rests on, when it is grasped and when it is released.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from manipulation.grasp_config import GraspConfig, half_turn, on_hand, tcp_pose
from manipulation.hand_collision import HandBoxes, HandClearance, surface_points
from manipulation.types import RIMMED, TOO_WIDE, Grasp, GraspSet, Rejected, StandingObject
from perception.types import TriangleMesh

MIN_ELEVATION = np.deg2rad(20.0)  # of the hand over a plane that the object rests on
_N_POINTS = 500  # of the surface, for which opposite ones are looked for
_N_DENSE = 2500  # points of the surface
# [m] below the top of a mug or bowl, where points are denser by a factor: one on its side that is wider than
# the hand can be held there alone.
_RIM, _DENSER = 0.02, 10.0
_SMOOTHING = 0.006  # [m] over which normals are averaged: about half a pad
_FRICTION_ANGLE = np.deg2rad(18.0)
_LATERAL = 0.003  # [m] largest distance of the opposite point from the line
_N_PAIRS, _N_GRASPS, _PER_PAIR = 160, 48, 3  # upper limits
_APART, _TURNED = 0.010, np.deg2rad(25.0)  # [m], [rad], of which pairs differ by one at least
_N_APPROACHES = 24  # about the closing direction
_MARGINS = (0.012, 0.006, 0.003)  # [m] of each finger beside the object before closing, in order
_PAD_HALF_WIDTH = 0.0085  # [m]
_TOUCHING = 0.003  # [m] between pad and surface, within which they are in contact
_MIN_CONTACT = 0.3  # share of the pads
_CLEARANCE = HandClearance(distance=0.0005, approach=0.06)
_DISTANCE = 0.004  # [m] of the hand from other things
_NOTHING = np.zeros((0, 3))


@dataclass(frozen=True)
class Pair:
    """Opposite places of a surface.

    Attributes:
        middle: (3,) point between them in [m].
        closing: (3,) unit vector from one to the other.
        width: distance along it in [m].
    """

    middle: Float[np.ndarray, "3"]
    closing: Float[np.ndarray, "3"]
    width: float


def antipodal_grasps(
    item: StandingObject,
    ups: Sequence[Float[np.ndarray, "3"]],
    config: GraspConfig = GraspConfig(),
    surroundings: Float[np.ndarray, "n 3"] = _NOTHING,
    sides: Sequence[Float[np.ndarray, "3"]] = (),
) -> GraspSet:
    """Return grasps with the hand above all planes that the object rests on, best first.

    Args:
        item: the object.
        ups: normals, in the stand frame, of the planes that it rests on when it is grasped and released.
        config: settings of grasp generation.
        surroundings: points of other things, in the stand frame in [m], that the hand is not to meet when it
            grasps.
        sides: normals of further planes, of which the hand is to be above at least one.
    """
    max_width = config.gripper.max_width
    rim = item.top - _RIM if item.category in RIMMED else np.inf
    opposite = _opposite_places(_ById(item.vertices), _ById(item.faces), rim, max_width - 0.004)
    rejected: Counter[str] = Counter()
    if opposite.n_too_wide:
        rejected[f"{TOO_WIDE} for {max_width:.2f} m"] = opposite.n_too_wide
    surface = opposite.surface
    planes = [(*ups, side) for side in sides] or [tuple(ups)]
    hands = [_HandSpace(item, surface.tree.data, normals, surroundings, config) for normals in planes]
    grasps: list[Grasp] = []
    for pair in opposite.pairs:
        found: list[Grasp] = []
        reason = ""
        for hand in hands:
            at_pair = _at_pair(pair, hand, surface)
            if isinstance(at_pair, Rejected):
                reason = at_pair.reason
            else:
                found += at_pair
        if not found:
            rejected[reason] += 1
        grasps += found
    ordered = sorted(grasps, key=lambda grasp: -grasp.score)[:_N_GRASPS]
    # What is mounted on one side of the hand, as the camera, may be in the way with one of them alone.
    both = tuple(turned for grasp in ordered for turned in (grasp, half_turn(grasp)))
    return on_hand(GraspSet(both, rejected), config.gripper)


@dataclass(frozen=True)
class _Surface:
    """Points of a surface.

    Attributes:
        points, normals: (n, 3) points in [m], denser at rims, and outward normals averaged over a pad's half.
        tree: denser points, spread evenly.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    tree: KDTree

    @staticmethod
    def of(mesh: TriangleMesh, rim: float = np.inf) -> _Surface:
        """Return points of a surface, which are denser above the height ``rim`` [m]."""
        rng = np.random.default_rng(0)
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        crossed = np.cross(b - a, c - a)
        area = np.linalg.norm(crossed, axis=1)
        weight = np.where((a + b + c)[:, 2] / 3 > rim, _DENSER, 1.0) * area
        face = rng.choice(len(area), _N_DENSE, p=weight / weight.sum())
        u, v = rng.random((2, _N_DENSE, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        points = a[face] + u * (b - a)[face] + v * (c - a)[face]
        normals = crossed[face] / area[face, None]
        smooth = np.zeros_like(points)
        for index, near in enumerate(KDTree(points).query_ball_point(points, _SMOOTHING)):
            same_side = normals[near] @ normals[index] > 0.3  # not those of the other side of a wall
            smooth[index] = normals[near][same_side].sum(axis=0)
        smooth /= np.linalg.norm(smooth, axis=1, keepdims=True)
        return _Surface(points, smooth, KDTree(surface_points(mesh)))


def antipodal_pairs(surface: _Surface) -> list[Pair]:
    """Return pairs of a surface's points in descending order of the alignment of their normals."""
    first, inward = surface.points[:_N_POINTS], -surface.normals[:_N_POINTS]
    opposition = inward @ surface.normals.T
    i, j = np.nonzero(opposition > np.cos(2 * _FRICTION_ANGLE))
    apart = surface.points[j] - first[i]
    depth = (apart * inward[i]).sum(axis=1)
    lateral = (apart**2).sum(axis=1) - depth**2
    possible = np.flatnonzero((lateral < _LATERAL**2) & (depth > 1e-3))
    order = possible[np.argsort(-opposition[i[possible], j[possible]], kind="stable")]
    i, j, apart = i[order], j[order], apart[order]
    closings = surface.normals[j] + inward[i]
    closings /= np.linalg.norm(closings, axis=1, keepdims=True)
    middles, widths = (first[i] + surface.points[j]) / 2, (closings * apart).sum(axis=1)
    return [Pair(middle, closing, float(width)) for middle, closing, width in zip(middles, closings, widths)]


@dataclass(frozen=True)
class _OppositePlaces:
    """Places of a surface between which it can be held.

    Attributes:
        surface: the surface.
        pairs: distinct pairs within the width.
        n_too_wide: number of pairs beyond it.
    """

    surface: _Surface
    pairs: tuple[Pair, ...]
    n_too_wide: int


class _ById:
    """An array as the key of a cache, the same only as itself."""

    __slots__ = ("array",)

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def __hash__(self) -> int:
        return id(self.array)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ById) and self.array is other.array


@lru_cache(maxsize=64)
def _opposite_places(vertices: _ById, faces: _ById, rim: float, width: float) -> _OppositePlaces:
    """Return the opposite places of a mesh; its grasps are looked for in many poses and scenes.

    Args:
        vertices, faces: the mesh.
        rim: height [m] above which points are denser.
        width: largest width of a pair in [m].
    """
    surface = _Surface.of(TriangleMesh(vertices.array, faces.array), rim)
    pairs = antipodal_pairs(surface)
    fitting = [pair for pair in pairs if pair.width <= width]
    return _OppositePlaces(surface, tuple(_distinct(fitting)), len(pairs) - len(fitting))


@dataclass(frozen=True)
class _HandSpace:
    """What the hand is not to meet.

    Attributes:
        item: the object.
        own: (n, 3) points of the object in [m].
        ups: normals of the planes that it rests on.
        surroundings: (m, 3) points of other things in [m].
        config: settings of grasp generation.
    """

    item: StandingObject
    own: Float[np.ndarray, "n 3"]
    ups: tuple[Float[np.ndarray, "3"], ...]
    surroundings: Float[np.ndarray, "m 3"]
    config: GraspConfig

    def opening(self, T_stand_tcp: Float[np.ndarray, "4 4"], width: float) -> float | Rejected:
        """Return the largest opening [m] with which the hand meets neither object, planes nor others."""
        R, position = T_stand_tcp[:3, :3], T_stand_tcp[:3, 3]
        gripper, back = self.config.gripper, np.array([0.0, 0.0, -_CLEARANCE.approach])
        own, others = (self.own - position) @ R, (self.surroundings - position) @ R
        rejected = Rejected("without room for the fingers")
        for margin in _MARGINS:
            opening = min(gripper.max_width, width + 2 * margin)
            boxes = HandBoxes.of(gripper, opening, _CLEARANCE.hand_length)
            if not self._is_above(boxes, R, position):
                continue
            if len(others) and boxes.sweep_contains(others, back, _DISTANCE):
                rejected = Rejected("blocked by what is around it")
            elif not boxes.sweep_contains(own, back, _CLEARANCE.distance):
                return opening
        return rejected

    def _is_above(self, boxes: HandBoxes, R: np.ndarray, position: np.ndarray) -> bool:
        """Return whether the hand is above all planes."""
        vertices, clearance = self.item.vertices, self.config.fingertip_clearance
        heights = (up @ position - float((vertices @ up).min()) + _lowest(boxes, R.T @ up) for up in self.ups)
        return all(height > clearance for height in heights)


def _at_pair(pair: Pair, hand: _HandSpace, surface: _Surface) -> list[Grasp] | Rejected:
    """Return the grasps between two places, the highest approaches first."""
    item, config = hand.item, hand.config
    if pair.width < config.gripper.min_width + 0.0008:
        return Rejected("thinner than the closed hand")
    found: list[Grasp] = []
    reason = "without an approach from above"
    center = surface.tree.data.mean(axis=0)
    for elevation, approach in _approaches(pair.closing, hand.ups):
        T = tcp_pose(pair.middle, approach, pair.closing)
        contact = _contact(T, pair.width, surface.tree)
        if contact < _MIN_CONTACT:
            reason = "with too little contact"
            continue
        opening = hand.opening(T, pair.width)
        if isinstance(opening, Rejected):
            reason = opening.reason
            continue
        lever = float(np.linalg.norm(pair.middle - center))
        found.append(_grasp(item, pair, T, opening, contact + 0.5 * elevation - 4.0 * lever, config))
        if len(found) == _PER_PAIR:
            break
    return found or Rejected(reason)


def _distinct(pairs: Sequence[Pair]) -> Iterator[Pair]:
    """Yield pairs that differ from all before them in place or direction."""
    kept: list[Pair] = []
    middles, closings = np.zeros((0, 3)), np.zeros((0, 3))
    for pair in pairs:
        near = np.linalg.norm(middles - pair.middle, axis=1) < _APART
        parallel = np.abs(closings @ pair.closing) > np.cos(_TURNED)
        if (near & parallel).any():
            continue
        kept.append(pair)
        middles, closings = np.vstack([middles, pair.middle]), np.vstack([closings, pair.closing])
        yield pair
        if len(kept) == _N_PAIRS:
            return


def _approaches(
    closing: Float[np.ndarray, "3"], ups: Sequence[Float[np.ndarray, "3"]]
) -> list[tuple[float, Float[np.ndarray, "3"]]]:
    """Return least elevations [rad] and approaches across the closing direction, the highest first."""
    first = np.cross(closing, np.eye(3)[np.argmin(np.abs(closing))])
    first /= np.linalg.norm(first)
    second = np.cross(closing, first)
    angles = 2 * np.pi * np.arange(_N_APPROACHES) / _N_APPROACHES
    aways = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    elevation = np.arcsin(np.clip(aways @ np.array(ups).T, -1, 1)).min(axis=1)
    order = [k for k in np.argsort(-elevation, kind="stable") if elevation[k] >= MIN_ELEVATION]
    return [(float(elevation[k]), -aways[k]) for k in order]


def _contact(T_stand_tcp: Float[np.ndarray, "4 4"], width: float, tree: KDTree) -> float:
    """Return the share of the pads that is in contact, of the one with less."""
    steps = np.linspace(-1.0, 1.0, 5) * _PAD_HALF_WIDTH
    x, z = (grid.ravel() for grid in np.meshgrid(steps, steps))
    shares = []
    for y in (-width / 2, width / 2):
        pad = np.stack([x, np.full_like(x, y), z], axis=1) @ T_stand_tcp[:3, :3].T + T_stand_tcp[:3, 3]
        shares.append(float(np.mean(tree.query(pad, distance_upper_bound=_TOUCHING)[0] < _TOUCHING)))
    return min(shares)


def _lowest(boxes: HandBoxes, up: Float[np.ndarray, "3"]) -> float:
    """Return the smallest component of the corners along ``up`` (hand frame), relative to the TCP [m]."""
    return float(np.minimum(boxes.low * up, boxes.high * up).sum(axis=1).min())


def _grasp(
    item: StandingObject,
    pair: Pair,
    T_stand_tcp: Float[np.ndarray, "4 4"],
    opening: float,
    score: float,
    config: GraspConfig,
) -> Grasp:
    return Grasp(
        kind="antipodal",
        T_stand_tcp=T_stand_tcp,
        away=-T_stand_tcp[:3, 2],
        opening=opening,
        held_width=pair.width,
        closed_width=(max(0.5 * pair.width, config.gripper.min_width + 0.0008), opening - 0.002),
        release_opening=min(pair.width + 2 * config.release_gap, opening),
        depth=float(item.top - pair.middle[2]),
        azimuth=float(np.arctan2(-T_stand_tcp[1, 2], -T_stand_tcp[0, 2])),
        score=score,
    )
