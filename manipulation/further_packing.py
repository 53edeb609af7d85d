"""Plan for what is packed after the others: goals on the floor that is left, and bowls into bowls.

Where something finds no room, one of the objects in the box is moved if that makes room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from manipulation.errors import PlanningError
from manipulation.free_places import Hold, free_places
from manipulation.grasps import grasp_candidates
from manipulation.kinematics import Kinematics
from manipulation.lying_grasps import lies
from manipulation.nesting import nest_heights, nests, radial_surfaces
from manipulation.packing import admissible_yaws, nest_drop
from manipulation.planner import ManipulationConfig, find_usable
from manipulation.robot import ArmDescription
from manipulation.types import Box, GraspSet, Placement, StandingObject, TaskPlan
from perception.geometry import pose_from_yaw, yaw_of
from perception.types import ObjectEstimate

_IN_NEST = 0.03  # [m] between the axes of nested bowls
_YAWS = 2 * np.pi * np.arange(8) / 8  # of mugs, if none is in the box


def plan_further(
    objects: Sequence[ObjectEstimate],
    placed: Mapping[str, StandingObject],
    box: Box,
    arm: ArmDescription,
    config: ManipulationConfig = ManipulationConfig(),
    kinematics: Kinematics | None = None,
) -> TaskPlan:
    """Plan to pack objects into a box that holds others, of which at most one is moved to make room.

    Args:
        objects: object map of what is beside the box.
        placed: objects in the box where they are, by name.
        box: target box.
        arm: description of the arm.
        config: settings.
        kinematics: kinematics of the arm; built if None.

    Raises:
        PlanningError: no object can be packed; the message gives the reasons.
    """
    config = config.for_arm(arm)
    usable = find_usable(objects, kinematics or Kinematics(arm, config.pick_place.ik), config)
    items = sorted(usable.candidates, key=_order)
    placements, no_room = _most_in_place(items, placed, box, config, usable.grasps)
    if not placements:
        raise PlanningError("; ".join(no_room.values()))
    return TaskPlan(
        "pack",
        usable.items | dict(placed),
        tuple(placements),
        usable.left_out | no_room,
        box=box,
        grasps=usable.grasps,
    )


def loose_bowl(
    placed: Mapping[str, StandingObject], box: Box, config: ManipulationConfig = ManipulationConfig()
) -> StandingObject | None:
    """Return the smallest bowl that stands alone in the box although it fits into another; None without any.

    Args:
        placed: objects in the box where they are, by name.
        box: the box.
        config: settings.
    """
    bowls = [item for item in placed.values() if item.category == "bowl" and not lies(item.T_world_stand)]
    for bowl in sorted(bowls, key=lambda bowl: bowl.size):
        others = {item.name: item for item in bowls if item.name != bowl.name}
        if not _shares_axis(bowl, placed) and _into_bowls(bowl, others, box, config) is not None:
            return bowl
    return None


def _most_in_place(
    items: Sequence[StandingObject],
    placed: Mapping[str, StandingObject],
    box: Box,
    config: ManipulationConfig,
    grasps: Mapping[str, GraspSet],
) -> tuple[list[Placement], dict[str, str]]:
    """Return goals that leave as few objects out as possible, and the reason by name for each of those.

    The first of these ways that leaves none out: with much room around each object, with little room, and
    with one object in the box moved, the narrowest first.
    """
    best = _in_place(items, placed, box, config, grasps)
    if not best[1]:
        return best
    ways = [(items, dict(placed))]
    for moved in sorted(_movable(placed), key=_floor_space):
        ways.append(((*items, moved), {name: other for name, other in placed.items() if name != moved.name}))
    for wanted, there in ways:
        goals, no_room = _in_place(wanted, there, box, config, grasps, is_snug=True)
        if len(no_room) < len(best[1]) and not no_room.keys() & placed.keys():
            # What is moved makes room for the others.
            best = sorted(goals, key=lambda goal: goal.name not in placed), no_room
        if not best[1]:
            break
    return best


def _in_place(
    items: Sequence[StandingObject],
    placed: Mapping[str, StandingObject],
    box: Box,
    config: ManipulationConfig,
    grasps: Mapping[str, GraspSet],
    is_snug: bool = False,
) -> tuple[list[Placement], dict[str, str]]:
    """Return a goal for each object in turn, and the reason by name for each that finds no room.

    What lies in the box takes the place of others until it is turned.
    """
    there, placements, no_room = dict(placed), [], {}
    there |= {
        item.name: item for item in items if lies(item.T_world_stand) and box.contains(item.T_world_stand)
    }
    for item in items:
        others = {name: other for name, other in there.items() if name != item.name}
        goal = _into_bowls(item, others, box, config)
        if goal is None:
            known = grasps.get(item.name) or grasp_candidates(item, config.pick_place.grasp)
            hold = Hold(known.grasps, config.pick_place.grasp.gripper)
            goal = _on_the_floor(item, others, box, config, hold, is_snug)
        if goal is None:
            no_room[item.name] = f"no room for {item.name} is left in the box; use a larger box"
            continue
        for moved, to in (item, goal), *_into_larger(item, goal, there, placed, box, config):
            placements.append(to)
            there[moved.name] = replace(moved, T_world_stand=_resting_pose(moved, to, there))
    return placements, no_room


def _into_larger(
    item: StandingObject,
    goal: Placement,
    there: Mapping[str, StandingObject],
    placed: Mapping[str, StandingObject],
    box: Box,
    config: ManipulationConfig,
) -> list[tuple[StandingObject, Placement]]:
    """Return the bowls in the box that go into one that comes later, with their goals, at most one.

    A bowl that lay in a larger one on the table may be in the box before that.

    Args:
        item: what comes, and its goal on the floor.
        goal: its goal.
        there: objects in the box by then.
        placed: those that are there now.
        box: target box.
        config: settings.
    """
    if item.category != "bowl" or goal.stack:
        return []
    standing = replace(item, T_world_stand=_resting_pose(item, goal, there))
    alone = [
        other
        for other in placed.values()
        if other.category == "bowl" and not lies(other.T_world_stand) and not _shares_axis(other, there)
    ]
    for inner in sorted(alone, key=lambda bowl: -bowl.size):
        nest = _into_bowls(inner, {item.name: standing}, box, config)
        if nest is not None:
            return [(inner, nest)]
    return []


def _shares_axis(bowl: StandingObject, there: Mapping[str, StandingObject]) -> bool:
    """Return whether another object stands in or under a bowl."""
    axis = bowl.T_world_stand[:2, 3]
    others = (other for name, other in there.items() if name != bowl.name)
    return any(np.linalg.norm(other.T_world_stand[:2, 3] - axis) < _IN_NEST for other in others)


def _movable(placed: Mapping[str, StandingObject]) -> list[StandingObject]:
    """Return the upright objects in the box that are no bowls: these may hold others."""
    return [item for item in placed.values() if item.category != "bowl" and not lies(item.T_world_stand)]


def _floor_space(item: StandingObject) -> float:
    """Return the area of the top view's bounding rectangle in [m²]."""
    return float(np.prod(np.ptp(item.vertices[:, :2], axis=0)))


def _order(item: StandingObject) -> tuple[bool, float]:
    """Bowls from the largest up, then the others by height to keep the hand above."""
    is_bowl = item.category == "bowl"
    return not is_bowl, -item.size if is_bowl else item.top


def _into_bowls(
    item: StandingObject, there: Mapping[str, StandingObject], box: Box, config: ManipulationConfig
) -> Placement | None:
    """Return a goal in the uppermost bowl of a stack in the box; None if it is no bowl or fits none."""
    if item.category != "bowl":
        return None
    bowls = sorted(
        (other for other in there.values() if other.category == "bowl"), key=lambda b: b.T_world_stand[2, 3]
    )
    for lowest in bowls:
        axis = lowest.T_world_stand[:2, 3]
        stack = [b for b in bowls if np.linalg.norm(b.T_world_stand[:2, 3] - axis) < _IN_NEST]
        if stack[0] is not lowest or nests(radial_surfaces(item), radial_surfaces(stack[-1])) is None:
            continue
        x, y = stack[-1].T_world_stand[:2, 3]
        grasp = config.pick_place.grasp
        drop = nest_drop([*stack, item], grasp.bowl_depth, config.packing, grasp.gripper)
        names = tuple(bowl.name for bowl in stack)
        return Placement(
            item.name, (float(x), float(y), box.floor), admissible_yaws(item, 0.0), names, release_height=drop
        )
    return None


def _on_the_floor(
    item: StandingObject,
    there: Mapping[str, StandingObject],
    box: Box,
    config: ManipulationConfig,
    hold: Hold,
    is_snug: bool,
) -> Placement | None:
    """Return a goal where most floor is free, or least; a mug is aligned with those in the box.

    One with room for the hand comes first. None without room.
    """
    others = [(other, other.T_world_stand) for other in there.values()]
    for yaw in _yaws(item, there):
        goal = Placement(
            item.name,
            (*box.center, box.floor),
            admissible_yaws(item, yaw),
            release_height=config.packing.release_height,
        )
        places = free_places(item, goal, others, box, is_snug=is_snug, hold=hold)
        if places:
            return places[0]
    return None


def _yaws(item: StandingObject, there: Mapping[str, StandingObject]) -> Sequence[float]:
    """Return yaws [rad] to try for an object in the box."""
    if item.category != "mug":
        return (0.0,) if item.is_round else (0.0, np.pi / 2)
    mugs = [other.T_world_stand for other in there.values() if other.category == "mug"]
    return [yaw_of(T[:3, :3]) for T in mugs[:1]] or [float(yaw) for yaw in _YAWS]


def _resting_pose(
    item: StandingObject, goal: Placement, there: Mapping[str, StandingObject]
) -> Float[np.ndarray, "4 4"]:
    stack = [*(there[name] for name in goal.stack), item]
    lift = nest_heights(stack)[-1] if goal.stack else 0.0
    return pose_from_yaw(goal.yaws[0], np.add(goal.position, (0.0, 0.0, lift)))
