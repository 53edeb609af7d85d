"""Straight TCP segments of a pick (approach, lift) and of a place (lowering, release, retreat).

A segment is feasible if the arm reaches all of it and it has no contacts but the necessary ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from manipulation.collision import AllowedContacts
from manipulation.lifting import LiftConfig, Postures, find_lift, moved
from manipulation.motions import OUT_OF_REACH, MotionPlanner
from manipulation.obstacles import BOX_FLOOR, TABLE
from manipulation.types import Grasp, Placement, Rejected, StandingObject


@dataclass(frozen=True)
class SegmentConfig:
    """Lengths and clearances of the straight segments.

    Attributes:
        approach_heights, retreat_heights: lengths of approach and retreat in [m], tried in order. The
            approach begins so high that the wrist camera sees the object.
        lift: settings of the lift.
        raise_heights: heights above the goal from which the object is lowered, in [m]. The first is used at
            which it has the largest clearance that any of them gives it.
        raised_margins: clearances in [m] at that height, in descending order.
        placing_margin: clearance of the carried object from its neighbours while it is lowered, in [m].
        settle_depth: descent in [m] with loosened pads before they release what may hang on one.
        release_extras: additional opening of each finger at release in [m], tried in order: a finger close to
            a sloping wall may drag the object along.
    """

    approach_heights: tuple[float, ...] = (0.16, 0.10, 0.06)
    retreat_heights: tuple[float, ...] = (0.10, 0.06)
    lift: LiftConfig = field(default_factory=LiftConfig)
    raise_heights: tuple[float, ...] = (0.12, 0.18, 0.25, 0.32, 0.08)
    raised_margins: tuple[float, ...] = (0.03, 0.02, 0.012, 0.008, 0.004)
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
    lift = find_lift(motions, name, grasp, q, T_grasp, config.lift)
    return lift if isinstance(lift, Rejected) else Pick(grasp, approach[::-1], lift)


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
    return moved(T, np.array([0.0, 0.0, height]))
