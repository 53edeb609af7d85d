"""The straight parts of a pick and of a place: approach and lift, lowering, letting go and retreat.

Each is a short TCP line that the arm must reach and on which nothing may be touched but what has to be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.collision import Allowance
from manipulation.motions import Motions
from manipulation.obstacles import BOX_FLOOR, TABLE
from manipulation.types import Grasp, Placement, StandingObject

Postures = Float[np.ndarray, "_k n"]  # several of them in one value differ in length


@dataclass(frozen=True)
class HandlingConfig:
    """Lengths and margins of the straight parts.

    Attributes:
        approach_heights: lengths of the straight approach and retreat to try, in [m].
        lift_heights: straight up from the grasp, in [m], tried in order.
        raise_heights: above the goal from which the object is lowered, in [m], tried in order.
        lift_margin: kept by the object while it is lifted out from among its neighbours, in [m].
        placing_margin: kept between the carried object and its neighbours while it is lowered, in [m].
        settle_depth: by which the loose pads sink before they open wide at a bowl, in [m].
        release_extras: by how much further than it must each finger opens to let go, in [m], tried in order:
            a finger that stays near a sloping wall may drag the object along.
    """

    approach_heights: tuple[float, ...] = (0.10, 0.06)
    lift_heights: tuple[float, ...] = (0.20, 0.12, 0.28)
    raise_heights: tuple[float, ...] = (0.12, 0.18, 0.25, 0.08)
    lift_margin: float = 0.002
    placing_margin: float = 0.001
    settle_depth: float = 0.004
    release_extras: tuple[float, ...] = (0.008, 0.004, 0.0)


@dataclass(frozen=True)
class Pick:
    """A reachable, free way to take an object: postures of the approach and of the lift, in [rad]."""

    grasp: Grasp
    approach: Postures
    lift: Postures


@dataclass(frozen=True)
class Place:
    """A reachable, free way to set an object down: postures of lowering, settling (or None) and retreat.

    Attributes:
        T_world_stand_goal: (4, 4) of the object when it is let go.
        release_opening: width between the pads that lets go, in [m].
    """

    T_world_stand_goal: Float[np.ndarray, "4 4"]
    lowering: Postures
    release_opening: float
    settle: Postures | None
    retreat: Postures


def find_pick(motions: Motions, name: str, grasp: Grasp, config: HandlingConfig) -> Pick | str:
    """Approach and lift for one grasp of an object, or why it fails; leaves the object in the hand."""
    world, kinematics = motions.world, motions.kinematics
    world.release()
    T_grasp = world.pose(name) @ grasp.T_stand_tcp
    result = kinematics.inverse(T_grasp, kinematics.seeds_toward(T_grasp, 3), name=name)
    if not result.converged:
        return "out of reach"
    own = Allowance(touch=frozenset({name}))
    contact = world.contact(result.q, grasp.opening, own)
    if contact:
        return _short(contact)
    backed = _backed(T_grasp, grasp, config.approach_heights)
    approach = motions.free_line(result.q, backed, grasp.opening, own)
    if isinstance(approach, str):
        return _short(approach)
    world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
    off_the_table = Allowance(touch_carried=frozenset({TABLE.name}), carried_margin=config.lift_margin)
    raised = [_raised(T_grasp, height) for height in config.lift_heights]
    lift = motions.free_line(result.q, raised, grasp.held_width, off_the_table)
    if isinstance(lift, str):
        return _short(lift)
    return Pick(grasp, approach[::-1], lift)


def find_place(
    motions: Motions,
    pick: Pick,
    item: StandingObject,
    placement: Placement,
    T_rest: Float[np.ndarray, "4 4"],
    config: HandlingConfig,
) -> Place | str:
    """Lowering, release and retreat for one resting pose, or why it fails; leaves the object in the hand."""
    world, kinematics, grasp, name = motions.world, motions.kinematics, pick.grasp, item.name
    T_goal = _raised(T_rest, placement.release_height)
    T_place = T_goal @ grasp.T_stand_tcp
    seeds = [pick.lift[-1], *kinematics.seeds_toward(T_place, 2)]
    result = kinematics.inverse(T_place, seeds, name=f"the goal of {name}")
    if not result.converged:
        return "with the goal out of reach"
    stack = frozenset(placement.stack)
    world.release()
    touch = Allowance(touch=stack | {name})
    settle = None
    if item.category == "bowl" and not stack:
        settle = _settling(motions, grasp, result.q, T_place, touch, config)
    q_loose = result.q if settle is None else settle[-1]
    release_opening, retreat = _letting_go(motions, grasp, q_loose, T_place, touch, config)
    if isinstance(retreat, str):
        return f"letting go: {_short(retreat)}"
    world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
    into = Allowance(stack, stack | {TABLE.name, BOX_FLOOR}, carried_margin=config.placing_margin)
    raised = [_raised(T_place, height) for height in config.raise_heights]
    lowering = motions.free_line(result.q, raised, grasp.held_width, into)
    if isinstance(lowering, str):
        return f"placing: {_short(lowering)}"
    return Place(T_goal, lowering[::-1], release_opening, settle, retreat)


def _settling(
    motions: Motions,
    grasp: Grasp,
    q: np.ndarray,
    T_place: np.ndarray,
    allow: Allowance,
    config: HandlingConfig,
) -> Postures | None:
    """Postures that lower the loose pads past the lip of a bowl; None where there is no room."""
    target = _raised(T_place, -config.settle_depth)
    settle = motions.free_line(q, [target], grasp.release_opening, allow)
    return None if isinstance(settle, str) else settle


def _letting_go(
    motions: Motions,
    grasp: Grasp,
    q: np.ndarray,
    T_place: np.ndarray,
    allow: Allowance,
    config: HandlingConfig,
) -> tuple[float, Postures | str]:
    """The widest opening with which the hand is free to leave, and postures of the retreat from ``q``."""
    targets = _backed(T_place, grasp, config.approach_heights)
    least, most = grasp.release_opening, max(grasp.opening, grasp.release_opening)
    width, retreat = least, "out of reach"
    for extra in config.release_extras:
        width = min(least + 2 * extra, most)
        retreat = motions.free_line(q, targets, width, allow)
        if not isinstance(retreat, str):
            break
    return width, retreat


def _backed(T_world_tcp: np.ndarray, grasp: Grasp, distances: Sequence[float]) -> list[np.ndarray]:
    """The TCP pose of a grasp drawn back by each distance [m] the way the hand leaves."""
    away = T_world_tcp[:3, :3] @ grasp.T_stand_tcp[:3, :3].T @ grasp.away
    backed = [T_world_tcp.copy() for _ in distances]
    for T, distance in zip(backed, distances):
        T[:3, 3] += distance * away
    return backed


def _raised(T: np.ndarray, height: float) -> np.ndarray:
    raised = T.copy()
    raised[2, 3] += height
    return raised


def _short(contact: str) -> str:
    """A contact as a countable reason: "arm meets bowl_2" becomes "collide with bowl_2"."""
    thing = contact.split(" meets ")[-1]
    return contact if thing == contact else f"collide with {thing}"
