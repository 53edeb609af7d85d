"""Whole tasks before the first motion: what goes where, in which order, and what has to stay out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from manipulation.errors import PlanningError
from manipulation.packing import PackingConfig, pack
from manipulation.pick_place import PickPlaceConfig, PickPlacePlanner
from manipulation.robot import ArmDescription
from manipulation.sorting import SortingConfig, sort_line
from manipulation.standing import stand
from manipulation.types import Box, Line, StandingObject, TaskPlan
from perception.types import ObjectEstimate, SupportPlane

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ManipulationConfig:
    """Everything that manipulation can be told.

    Attributes:
        pick_place: search for grasps and motions.
        packing, sorting: where objects go.
        support: the plane that objects stand on.
        max_retries: further attempts on an object after a failed one.
    """

    pick_place: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    packing: PackingConfig = field(default_factory=PackingConfig)
    sorting: SortingConfig = field(default_factory=SortingConfig)
    support: SupportPlane | None = None
    max_retries: int = 2

    def suiting(self, arm: ArmDescription) -> ManipulationConfig:
        """The same settings for the gripper of an arm."""
        grasp = replace(self.pick_place.grasp, gripper=arm.gripper)
        return replace(self, pick_place=replace(self.pick_place, grasp=grasp))


def plan_pack(
    objects: Sequence[ObjectEstimate],
    box: Box,
    arm: ArmDescription,
    config: ManipulationConfig | None = None,
) -> TaskPlan:
    """Plan to pack all objects that can be grasped, reached and fitted into the box.

    Raises:
        PlanningError: not one object can be packed; the message says why.
    """
    config = (config or ManipulationConfig()).suiting(arm)
    items, usable, left_out = _usable(objects, arm, config)
    placements, no_room = pack(usable, box, config.packing, config.pick_place.grasp)
    return TaskPlan("pack", items, placements, left_out | no_room, box=box)


def plan_sort(
    objects: Sequence[ObjectEstimate],
    line: Line,
    arm: ArmDescription,
    config: ManipulationConfig | None = None,
    box: Box | None = None,
) -> TaskPlan:
    """Plan to line up, ascending in size, all objects that can be grasped and reached.

    Args:
        box: an empty box that stands in the way, if there is one.

    Raises:
        PlanningError: not one object can be sorted; the message says why.
    """
    config = (config or ManipulationConfig()).suiting(arm)
    items, usable, left_out = _usable(objects, arm, config)
    placements, no_room = sort_line(usable, line, config.sorting)
    return TaskPlan("sort", items, placements, left_out | no_room, box=box, line=line)


def _usable(
    objects: Sequence[ObjectEstimate], arm: ArmDescription, config: ManipulationConfig
) -> tuple[dict[str, StandingObject], list[StandingObject], dict[str, str]]:
    """All standing objects by name, those the arm can take, and why not the others."""
    if not objects:
        raise PlanningError("there is nothing to handle: no object was perceived; scan again")
    items: dict[str, StandingObject] = {}
    left_out: dict[str, str] = {}
    for estimate in objects:
        try:
            items[estimate.name] = stand(estimate, config.support)
        except PlanningError as error:
            left_out[estimate.name] = str(error)
    planner = PickPlacePlanner(arm, items, config=config.pick_place)
    for name, item in items.items():
        found = planner.grasps(name)
        if not found.grasps:
            left_out[name] = found.why_none(name)
        elif not planner.reachable_grasp(name):
            x, y = item.T_world_stand[:2, 3]
            left_out[name] = f"{name} at ({x:.2f}, {y:.2f}) m is out of the arm's reach; move it closer"
    for reason in left_out.values():
        log.warning("left out: %s", reason)
    usable = [item for name, item in items.items() if name not in left_out]
    if not usable:
        raise PlanningError(f"none of {len(objects)} objects can be handled: {'; '.join(left_out.values())}")
    return items, usable, left_out
