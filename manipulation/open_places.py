"""Places for the objects of a task as box, rows and table are filled now."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from manipulation.free_places import Hold, free_places, roomier_place
from manipulation.free_table import Outline, outlines_of_others
from manipulation.lying_grasps import lies
from manipulation.packing import admissible_yaws
from manipulation.planner import ManipulationConfig
from manipulation.planning_scene import PlanningScene
from manipulation.types import Placement, StandingObject, TaskPlan
from perception.geometry import nearest_yaw

ON_ROW = 0.02  # [m] from a row, up to which an object stands on it


class OpenPlaces:
    """Finds places for objects in the scene as it is.

    Args:
        task: goals of all objects.
        scene: scene of planning, which follows the objects.
        config: settings.
    """

    def __init__(self, task: TaskPlan, scene: PlanningScene, config: ManipulationConfig) -> None:
        self._task, self._scene, self._config = task, scene, config

    def roomier(self, placement: Placement) -> Placement:
        """Return the planned place in the box, or one beside it with more room as the box is filled now."""
        box, objects = self._task.box, self._task.objects
        if self._task.task != "pack" or box is None or placement.stack:
            return placement
        inside = list(self._in_box(placement.name).values())
        return roomier_place(objects[placement.name], placement, inside, self._waiting(placement.name), box)

    def _in_box(self, name: str) -> dict[str, tuple[StandingObject, Float[np.ndarray, "4 4"]]]:
        """Return the objects in the box but one, with T_world_stand, by name."""
        box, objects = self._task.box, self._task.objects
        return {
            other: (objects[other], T)
            for other, T in self._scene.poses().items()
            if box is not None and other != name and box.contains(T)
        }

    def _waiting(self, name: str) -> list[tuple[StandingObject, Placement]]:
        """Return the objects but one that are to stand on the box's floor and are not in it, with goals."""
        there = self._in_box(name).keys() | {name}
        goals = (goal for goal in self._task.placements if goal.name not in there and not goal.stack)
        return [(self._task.objects[goal.name], goal) for goal in goals]

    def elsewhere(self, placement: Placement) -> list[Placement]:
        """Return other places for an object on the floor of the box."""
        if self._task.task != "pack" or self._task.box is None:
            return []
        if placement.stack:
            placement = replace(placement, stack=(), release_height=self._config.packing.release_height)
        objects = self._task.objects
        others = [(objects[n], T) for n, T in self._scene.poses().items() if n != placement.name]
        waiting = self._waiting(placement.name)
        hold = Hold(self._scene.grasps(placement.name).grasps, self._config.pick_place.grasp.gripper)
        return free_places(objects[placement.name], placement, others, self._task.box, waiting, hold=hold)

    def taken(self, name: str) -> list[Outline]:
        """Return the outlines of the top views of everything but one object."""
        scene = self._scene
        return outlines_of_others(self._task.objects, scene.poses(), scene.perceived_obstacles, {name})

    def in_place(self, known: Collection[str]) -> dict[str, Placement]:
        """Return the goals of keeping upright objects where they stand in the box or on a row, by name.

        Args:
            known: names of objects with other goals. Bowls in the box are left out as well: they may hold
                something.
        """
        task, config = self._task, self._config
        goals: dict[str, Placement] = {}
        for name, T in self._scene.poses().items():
            item = task.objects[name]
            if name in known or lies(T) or not self._is_in_place(item, T):
                continue
            floor = task.box.floor if task.task == "pack" and task.box is not None else 0.0
            settings = config.packing if task.task == "pack" else config.sorting
            position = (float(T[0, 3]), float(T[1, 3]), floor)
            yaws = admissible_yaws(item, nearest_yaw(T))
            goals[name] = Placement(name, position, yaws, release_height=settings.release_height)
        return goals

    def _is_in_place(self, item: StandingObject, T: Float[np.ndarray, "4 4"]) -> bool:
        """Return whether an object at a pose is in the box, and no bowl, or on a row."""
        task = self._task
        if task.task == "sort":
            return any(line.position(T[:2, 3])[1] < ON_ROW for line in task.lines)
        return task.box is not None and item.category != "bowl" and task.box.contains(T)
