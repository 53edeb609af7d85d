"""Task planning: goals of all objects and their order, and the objects that have to be excluded."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from manipulation.errors import PlanningError
from manipulation.free_table import FREE_AREA, Area
from manipulation.grasps import grasp_candidates
from manipulation.hidden_objects import hidden_objects
from manipulation.kinematics import Kinematics
from manipulation.lying_grasps import is_upside_down, lies
from manipulation.nearest_view import FULL_POSE
from manipulation.packing import pack
from manipulation.packing_problem import PackingConfig, resting_on
from manipulation.pick_place import PickPlaceConfig
from manipulation.reach import reaches_any
from manipulation.reorientation import reorienting_grasps
from manipulation.robot import ArmDescription
from manipulation.sorting import SortingConfig
from manipulation.sorting_rows import sort_rows
from manipulation.standing import to_lying, to_standing
from manipulation.types import Box, GraspSet, Line, Placement, StandingObject, TaskPlan
from manipulation.uncertainty import outer_vertices
from perception.types import ObjectEstimate, SupportPlane

logger = logging.getLogger(__name__)

_TURN_OVER = "turn it over by hand"


@dataclass(frozen=True)
class ManipulationConfig:
    """Settings of manipulation.

    Attributes:
        pick_place: search for grasps and motions.
        packing, sorting: layout of the goals.
        support: plane that objects stand on; the table top if None.
        max_retries: number of further attempts on an object after a failed one.
        free_area: ranges of x and y in which objects are turned and set aside, in [m].
    """

    pick_place: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    packing: PackingConfig = field(default_factory=PackingConfig)
    sorting: SortingConfig = field(default_factory=SortingConfig)
    support: SupportPlane | None = None
    max_retries: int = 2
    free_area: Area = FREE_AREA

    def for_arm(self, arm: ArmDescription) -> ManipulationConfig:
        """Return the same settings with an arm's gripper; with five joints the hand stays vertical."""
        grasp = replace(self.pick_place.grasp, gripper=arm.gripper)
        if len(arm.joint_names) < FULL_POSE:
            grasp = replace(grasp, max_tilt=0.0, max_inward_tilt=0.0)
        return replace(self, pick_place=replace(self.pick_place, grasp=grasp))


def plan_pack(
    objects: Sequence[ObjectEstimate],
    box: Box,
    arm: ArmDescription,
    config: ManipulationConfig = ManipulationConfig(),
    kinematics: Kinematics | None = None,
) -> TaskPlan:
    """Plan to pack all objects that can be grasped and reached and that fit into the box.

    Args:
        objects: object map.
        box: target box.
        arm: description of the arm.
        config: settings.
        kinematics: kinematics of the arm; built if None.

    Raises:
        PlanningError: no object can be packed; the message gives the reasons.
    """
    config = config.for_arm(arm)
    usable = find_usable(objects, kinematics or Kinematics(arm, config.pick_place.ik), config)
    hidden = hidden_objects(objects, usable.items, arm.gripper.max_width)
    names = {estimate.id: estimate.name for estimate in objects}
    resting = resting_on(objects) | {names[item.id]: item.name for item in hidden}
    usable, placements, no_room = _packed(usable, hidden, resting, box, config)
    return TaskPlan(
        "pack", usable.items, placements, usable.left_out | no_room, box=box, grasps=usable.grasps
    )


def _packed(
    usable: Usable,
    hidden: Sequence[StandingObject],
    resting: Mapping[str, str],
    box: Box,
    config: ManipulationConfig,
) -> tuple[Usable, tuple[Placement, ...], dict[str, str]]:
    """Return the objects with their goals in a box, and what does not fit.

    Where there is room for all, clearances are wide at uncertain surfaces, and places are left for what is
    hidden below other objects.
    """
    grasp = config.pick_place.grasp
    versions = (usable, usable.as_exact()) if usable.is_uncertain else (usable,)
    extras: Sequence[Sequence[StandingObject]] = (hidden, ()) if hidden else ((),)
    attempts = [(version, also) for also in extras for version in versions]
    version, placements, no_room = usable, (), {}
    for version, also in attempts:
        grasps = usable.grasps | {item.name: grasp_candidates(item, grasp) for item in also}
        placements, no_room = pack([*version.candidates, *also], box, config.packing, grasp, grasps, resting)
        if not no_room:
            break
    names = {item.name for item in hidden}
    return version, tuple(goal for goal in placements if goal.name not in names), no_room


def plan_sort(
    objects: Sequence[ObjectEstimate],
    line: Line,
    arm: ArmDescription,
    config: ManipulationConfig = ManipulationConfig(),
    box: Box | None = None,
    kinematics: Kinematics | None = None,
) -> TaskPlan:
    """Plan to arrange, ascending in size, all objects that can be grasped and reached.

    Where the line is too short, the larger objects stand on rows parallel to it.

    Args:
        objects: object map.
        line: target line.
        arm: description of the arm.
        config: settings.
        box: empty box that is an obstacle; None if there is none.
        kinematics: kinematics of the arm; built if None.

    Raises:
        PlanningError: no object can be sorted; the message gives the reasons.
    """
    config = config.for_arm(arm)
    usable = find_usable(objects, kinematics or Kinematics(arm, config.pick_place.ik), config)
    rows = sort_rows(usable.candidates, line, config.sorting)
    if rows.left_out and usable.is_uncertain:
        usable = usable.as_exact()
        rows = sort_rows(usable.candidates, line, config.sorting)
    left_out = usable.left_out | rows.left_out
    return TaskPlan("sort", usable.items, rows.placements, left_out, box, rows.lines, usable.grasps)


@dataclass(frozen=True)
class Usable:
    """Objects of a task.

    Attributes:
        items: all standing objects by name.
        left_out: name and reason of each object that cannot be grasped or reached.
        grasps: grasp candidates of all standing objects by name.
    """

    items: dict[str, StandingObject]
    left_out: dict[str, str]
    grasps: dict[str, GraspSet]

    @property
    def candidates(self) -> list[StandingObject]:
        """Objects that can be grasped and reached."""
        return [item for name, item in self.items.items() if name not in self.left_out]

    @property
    def is_uncertain(self) -> bool:
        """Whether clearances are widened for any object."""
        return any(outer_vertices(item) is not item.vertices for item in self.items.values())

    def as_exact(self) -> Usable:
        """Return the objects with ordinary clearances, for where there is no room for wider ones."""
        return replace(self, items={name: replace(i, sigma=np.zeros(0)) for name, i in self.items.items()})


def find_usable(
    objects: Sequence[ObjectEstimate], kinematics: Kinematics, config: ManipulationConfig
) -> Usable:
    """Separate the objects that the arm can grasp and reach from the others.

    Raises:
        PlanningError: there is no such object; the message gives the reasons.
    """
    if not objects:
        raise PlanningError("no object was perceived: repeat the scan")
    items: dict[str, StandingObject] = {}
    left_out: dict[str, str] = {}
    for estimate in objects:
        try:
            items[estimate.name] = _item(estimate, config)
        except PlanningError as error:
            left_out[estimate.name] = str(error)
    grasps = {name: grasp_candidates(item, config.pick_place.grasp) for name, item in items.items()}
    for name, item in items.items():
        now, (x, y) = grasps[name], item.T_world_stand[:2, 3]
        if lies(item.T_world_stand):
            now = reorienting_grasps(item, item.T_world_stand, config.pick_place.grasp)
        if not grasps[name].grasps:
            left_out[name] = grasps[name].failure_message(name)
        elif not now.grasps:
            overturned = is_upside_down(item.T_world_stand)
            how, remedy = ("stands upside down", _TURN_OVER) if overturned else ("lies on its side", "")
            left_out[name] = f"{name} {how} at ({x:.2f}, {y:.2f}) m: {now.failure_message(name, remedy)}"
        elif not reaches_any(kinematics, name, item.T_world_stand, now):
            left_out[name] = f"{name} at ({x:.2f}, {y:.2f}) m is out of the arm's reach; move it closer"
    for reason in left_out.values():
        logger.warning("excluded: %s", reason)
    usable = Usable(items, left_out, grasps)
    if not usable.candidates:
        reasons = "; ".join(left_out.values())
        raise PlanningError(f"none of {len(objects)} objects can be manipulated: {reasons}")
    return usable


def _item(estimate: ObjectEstimate, config: ManipulationConfig) -> StandingObject:
    """Return a standing object, or one that is to be turned first.

    Raises:
        PlanningError: the mesh is empty.
    """
    if lies(estimate.T_world_object):
        return to_lying(estimate)
    return to_standing(estimate, config.support)
