"""Straight TCP segments of a pick (approach, lift) and of a place (lowering, release, retreat).

A segment is feasible if the arm reaches all of it and it has no contacts but the necessary ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from manipulation.collision import AllowedContacts, CollisionWorld
from manipulation.motions import OUT_OF_REACH, MotionPlanner
from manipulation.obstacles import BOX_FLOOR, TABLE
from manipulation.standing import RAISED
from manipulation.types import Grasp, Placement, Rejected, StandingObject

SLIDE_DEPTH = 0.002  # [m] by which an object may get deeper in what it is lifted along
MAX_OVERLAP = 0.008  # [m] of estimated shapes in contact
MAX_HULL_OVERLAP = 0.02  # [m] of an object and the hulls of a thing, which fill the hollow beside it

Postures = Float[np.ndarray, "_k n"]  # several of them in one value differ in length


@dataclass(frozen=True)
class SegmentConfig:
    """Lengths and clearances of the straight segments.

    Attributes:
        approach_heights, retreat_heights: lengths of approach and retreat in [m], tried in order. The
            approach begins so high that the wrist camera sees the object.
        lift_heights: heights of the vertical lift in [m], tried in order until its end is clear.
        oblique_azimuths: azimuths in [rad] of a lift that is not vertical, from that away from what it would
            meet, tried in order.
        oblique_elevation: elevation of such a lift in [rad].
        raise_heights: heights above the goal from which the object is lowered, in [m]. The first is used at
            which it has the largest clearance that any of them gives it.
        raised_margins: clearances in [m] at that height, in descending order.
        lift_margin: clearance of the carried object from its neighbours during the lift in [m].
        lifted_margin: clearance of robot and carried object at the end of the lift, from where it is carried
            on, in [m].
        placing_margin: clearance of the carried object from its neighbours while it is lowered, in [m].
        settle_depth: descent in [m] with loosened pads before they release what may hang on one.
        release_extras: additional opening of each finger at release in [m], tried in order: a finger close to
            a sloping wall may drag the object along.
    """

    approach_heights: tuple[float, ...] = (0.16, 0.10, 0.06)
    retreat_heights: tuple[float, ...] = (0.10, 0.06)
    lift_heights: tuple[float, ...] = (0.20, 0.12, 0.28)
    oblique_azimuths: tuple[float, ...] = (0.0, 0.8, -0.8)
    oblique_elevation: float = 0.7
    raise_heights: tuple[float, ...] = (0.12, 0.18, 0.25, 0.32, 0.08)
    raised_margins: tuple[float, ...] = (0.03, 0.02, 0.012, 0.008, 0.004)
    lift_margin: float = 0.002
    lifted_margin: float = 0.004
    placing_margin: float = 0.001
    settle_depth: float = 0.004
    release_extras: tuple[float, ...] = (0.008, 0.004, 0.0)


HANGING = ("bowl", "bottle")  # classes whose lip or cap may hang on a pad that opens


@dataclass(frozen=True)
class Pick:
    """A feasible pick.

    Attributes:
        grasp: grasp of the object.
        approach, lift: (k, n) postures of the segments in [rad].
    """

    grasp: Grasp
    approach: Postures
    lift: Postures


@dataclass(frozen=True)
class PlaceGoal:
    """Goal pose of one placement.

    Attributes:
        item: object to be placed.
        placement: its goal.
        T_world_stand_rest: (4, 4) resting pose at one of the placement's yaws.
    """

    item: StandingObject
    placement: Placement
    T_world_stand_rest: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Place:
    """A feasible place.

    Attributes:
        T_world_stand_goal: (4, 4) pose of the stand frame when the object is released.
        lowering: (k, n) postures from above the goal down to it in [rad].
        release_opening: width between the pads that releases the object, in [m].
        settle: postures of the descent with loosened pads; None if there is none.
        retreat: postures of the retreat.
    """

    T_world_stand_goal: Float[np.ndarray, "4 4"]
    lowering: Postures
    release_opening: float
    settle: Postures | None
    retreat: Postures


_Found = TypeVar("_Found", Pick, Place)


def find_pick(motions: MotionPlanner, name: str, grasp: Grasp, config: SegmentConfig) -> Pick | Rejected:
    """Return approach and lift of one grasp; on success the world has the object attached to the hand.

    Where a link is in the way, other postures with the same pose of the hand are examined.
    """
    T_grasp, kinematics = motions.world.pose(name) @ grasp.T_stand_open, motions.kinematics
    result = kinematics.inverse(T_grasp, kinematics.seeds_toward(T_grasp, 3), name=name)
    if not result.converged:
        return OUT_OF_REACH
    return _first_free(motions, result.q, lambda q: _pick_in(motions, name, grasp, q, config))


def _first_free(
    motions: MotionPlanner, q: np.ndarray, examine: Callable[[np.ndarray], _Found | Rejected]
) -> _Found | Rejected:
    """Return what is found in a posture [rad]; in others with the same TCP pose if a link is in the way."""
    found = examine(q)
    if not (isinstance(found, Rejected) and found.by_arm):
        return found
    others = (examine(other) for other in motions.kinematics.self_motion(q))
    return next((other for other in others if not isinstance(other, Rejected)), found)


def _pick_in(
    motions: MotionPlanner, name: str, grasp: Grasp, q: np.ndarray, config: SegmentConfig
) -> Pick | Rejected:
    """Return approach and lift of a grasp in a posture [rad]."""
    world = motions.world
    world.release()
    T_grasp = world.pose(name) @ grasp.T_stand_open
    touch_object = AllowedContacts(touch=frozenset({name}))
    starts = _retreated(T_grasp, grasp, config.approach_heights)
    approach = motions.free_line(q, starts, grasp.opening, touch_object)
    if isinstance(approach, Rejected):
        return approach
    world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
    lift = _find_lift(motions, name, q, T_grasp, grasp.held_width, config)
    return lift if isinstance(lift, Rejected) else Pick(grasp, approach[::-1], lift)


def _find_lift(
    motions: MotionPlanner, name: str, q: np.ndarray, T_grasp: np.ndarray, width: float, config: SegmentConfig
) -> Postures | Rejected:
    """Return the postures of the lift of the carried object: up, or obliquely away from what it meets."""
    world = motions.world
    allowed = AllowedContacts(touch_carried=frozenset({TABLE.name}), carried_margin=config.lift_margin)
    lifted = [_raised(T_grasp, height) for height in config.lift_heights]
    lift = motions.free_line(q, lifted, width, allowed, config.lifted_margin)
    if not isinstance(lift, Rejected):
        return lift
    beside = in_contact(world, name, q, width, allowed)
    if beside is not None:
        allowed = beside
        lift = motions.free_line(q, lifted, width, allowed, config.lifted_margin)
    if not isinstance(lift, Rejected) or not lift.blocker or lift.by_arm:
        return lift
    away = world.pose(name)[:2, 3] - world.center(lift.blocker)[:2]
    for turn in config.oblique_azimuths:
        direction = _oblique(away, turn, config.oblique_elevation)
        oblique = [_moved(T_grasp, height * direction) for height in config.lift_heights]
        line = motions.free_line(q, oblique, width, allowed, config.lifted_margin)
        if not isinstance(line, Rejected):
            return line
    return lift


def _oblique(away: Float[np.ndarray, "2"], turn: float, elevation: float) -> Float[np.ndarray, "3"]:
    """Return the unit vector at an elevation [rad] over a horizontal direction turned about z [rad]."""
    azimuth = np.arctan2(away[1], away[0]) + turn
    horizontal = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return np.cos(elevation) * horizontal + np.array([0.0, 0.0, np.sin(elevation)])


def in_contact(
    world: CollisionWorld, name: str, q: np.ndarray, width: float, allowed: AllowedContacts
) -> AllowedContacts | None:
    """Return ``allowed`` with what an object in its place may touch; None if it touches nothing or is stuck.

    It slides along what it touches, hardly deeper in it than it is now: estimated shapes overlap. Hulls close
    cavities, so that it may be deep in what it stands in or on.
    """
    around, along = set(allowed.touch_carried), {}
    for other, depth in world.carried_overlaps(q, width).items():
        if other in allowed.touch_carried:
            continue
        is_object = other in world.names
        if is_object and world.base(name) > world.base(other) + (RAISED if depth < MAX_OVERLAP else 0.0):
            around.add(other)
        elif depth > (MAX_HULL_OVERLAP if other in world.perceived else MAX_OVERLAP):
            return None
        else:
            along[other] = max(depth, 0.0) + SLIDE_DEPTH
    if not along and around == allowed.touch_carried:
        return None
    return replace(allowed, touch_carried=frozenset(around), slide_carried=along)


def find_place(
    motions: MotionPlanner, pick: Pick, goal: PlaceGoal, config: SegmentConfig
) -> Place | Rejected:
    """Return lowering, release and retreat at one goal; on success the object is attached to the hand.

    Where a link is in the way, other postures with the same pose of the hand are examined.
    """
    kinematics = motions.kinematics
    T_place = _raised(goal.T_world_stand_rest, goal.placement.release_height) @ pick.grasp.T_stand_tcp
    seeds = [pick.lift[-1], *kinematics.seeds_toward(T_place, 2)]
    result = kinematics.inverse(T_place, seeds, name=f"the goal of {goal.item.name}")
    if not result.converged:
        return Rejected("with the goal out of reach")
    return _first_free(motions, result.q, lambda q: _place_in(motions, pick.grasp, goal, q, config))


def _place_in(
    motions: MotionPlanner, grasp: Grasp, goal: PlaceGoal, q: np.ndarray, config: SegmentConfig
) -> Place | Rejected:
    """Return lowering, release and retreat at one goal in a posture [rad]."""
    world, name, placement = motions.world, goal.item.name, goal.placement
    T_goal = _raised(goal.T_world_stand_rest, placement.release_height)
    T_place = T_goal @ grasp.T_stand_tcp
    stack = frozenset(placement.stack)
    world.release()
    touch = AllowedContacts(touch=stack | {name})
    settle = None
    if grasp.stand_off > 0:  # the fixed pad leaves the object
        line = motions.free_line(q, [T_goal @ grasp.T_stand_open], grasp.release_opening, touch)
        settle = None if isinstance(line, Rejected) else line
    elif goal.item.category in HANGING and not stack:
        # The pads are lowered past a lip or cap; the step is omitted where there is no room.
        lowered = [_raised(T_place, -config.settle_depth)]
        line = motions.free_line(q, lowered, grasp.release_opening, touch)
        settle = None if isinstance(line, Rejected) else line
    q_loose = q if settle is None else settle[-1]
    ends = _retreated(T_place, grasp, config.retreat_heights)
    release = _find_release(motions, grasp, q_loose, ends, touch, config.release_extras)
    if isinstance(release, Rejected):
        return replace(release, reason=f"without a collision-free release ({release.reason})")
    release_opening, retreat = release
    world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
    into = AllowedContacts(stack, stack | {TABLE.name, BOX_FLOOR}, carried_margin=config.placing_margin)
    raised = [_raised(T_place, height) for height in config.raise_heights]
    lowering = _find_lowering(motions, q, raised, grasp.held_width, into, config.raised_margins)
    if isinstance(lowering, Rejected):
        return replace(lowering, reason=f"{lowering.reason} while lowering")
    return Place(T_goal, lowering[::-1], release_opening, settle, retreat)


def _find_lowering(
    motions: MotionPlanner,
    q: np.ndarray,
    raised: Sequence[np.ndarray],
    width: float,
    allowed: AllowedContacts,
    margins: Sequence[float],
) -> Postures | Rejected:
    """Return the postures from ``q`` up to the first target above what is around it.

    The object arrives there sideways: a target between taller neighbours leaves it no clearance on the way.
    """
    rejected, blocked, found = OUT_OF_REACH, np.inf, []
    for target in raised:
        if target[2, 3] > blocked:
            continue
        line = motions.free_line(q, [target], width, allowed)
        if isinstance(line, Rejected):
            rejected = line
            blocked = float(target[2, 3]) if line.blocker else blocked
            continue
        rank = _first_kept(motions, line[-1], width, margins)
        if rank == 0:
            return line
        found.append((rank, line))
    return min(found, key=lambda ranked: ranked[0])[1] if found else rejected


def _first_kept(motions: MotionPlanner, q: np.ndarray, width: float, margins: Sequence[float]) -> int:
    """Return the index of the first clearance [m] that robot and carried object keep; the number if none."""
    for index, margin in enumerate(margins):
        kept = AllowedContacts(robot_margin=margin, carried_margin=margin)
        if motions.world.contact(q, width, kept) is None:
            return index
    return len(margins)


def _find_release(
    motions: MotionPlanner,
    grasp: Grasp,
    q: np.ndarray,
    targets: Sequence[np.ndarray],
    allowed: AllowedContacts,
    extras: Sequence[float],
) -> tuple[float, Postures] | Rejected:
    """Return the first opening [m] with a collision-free retreat from ``q`` to a target, and its postures."""
    smallest, largest = grasp.release_opening, max(grasp.opening, grasp.release_opening)
    rejected = OUT_OF_REACH
    for extra in extras:
        width = min(smallest + 2 * extra, largest)
        retreat = motions.free_line(q, targets, width, allowed)
        if not isinstance(retreat, Rejected):
            return width, retreat
        rejected = retreat
    return rejected


def _retreated(T_world_tcp: np.ndarray, grasp: Grasp, distances: Sequence[float]) -> list[np.ndarray]:
    """Return the TCP pose of a grasp translated by each distance [m] along the grasp's retreat."""
    away = T_world_tcp[:3, :3] @ grasp.T_stand_tcp[:3, :3].T @ grasp.away
    retreated = [T_world_tcp.copy() for _ in distances]
    for T, distance in zip(retreated, distances):
        T[:3, 3] += distance * away
    return retreated


def _raised(T: np.ndarray, height: float) -> np.ndarray:
    return _moved(T, np.array([0.0, 0.0, height]))


def _moved(T: np.ndarray, step: Float[np.ndarray, "3"]) -> np.ndarray:
    moved = T.copy()
    moved[:3, 3] += step
    return moved
