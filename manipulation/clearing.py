"""Makes room for the hand: objects are set aside on free table, or pushed to where they can be grasped."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Sequence

from manipulation.errors import GraspFailedError, RobotError, SceneChangedError
from manipulation.object_planning import ObjectPlanning
from manipulation.plan_execution import PlanExecution
from manipulation.pushing import Push
from manipulation.robot import Robot
from manipulation.scene_following import SceneFollowing
from manipulation.types import PickPlacePlan

logger = logging.getLogger(__name__)

MAX_PUSHES = 2  # of one object


class Clearing:
    """Sets each object aside at most once, and pushes it at most ``MAX_PUSHES`` times.

    After each motion the object is searched for if it may not be where it was to go.

    Args:
        robot: robot that executes the motions.
        planning: plans them.
        motion: carries them out.
        scene: searches for objects.
    """

    def __init__(
        self, robot: Robot, planning: ObjectPlanning, motion: PlanExecution, scene: SceneFollowing
    ) -> None:
        self._robot, self._planning, self._motion, self._scene = robot, planning, motion, scene
        self._set_aside: set[str] = set()
        self._pushes: Counter[str] = Counter()

    def plan_aside(self, names: Sequence[str], movable: Collection[str]) -> PickPlacePlan | None:
        """Return a plan that sets one of several objects aside; None if there is none.

        Args:
            names: objects that may be set aside, in descending order of preference.
            movable: objects that may be moved at all.
        """
        free = set(movable) - self._set_aside
        return next(iter(self._planning.plans_aside(names, free, self._robot.joint_positions())), None)

    def set_aside(self, plan: PickPlacePlan) -> None:
        """Set an object aside."""
        self._set_aside.add(plan.name)
        try:
            self._motion.run(plan)
        except (SceneChangedError, GraspFailedError, RobotError) as error:
            logger.info("%s was not set aside: %s", plan.name, error)
            if not isinstance(error, SceneChangedError):
                self._motion.recovery.back_off(plan.grasp)
            self._scene.search(plan.name)

    def plan_push(self, name: str) -> Push | None:
        """Return a push after which an object can be grasped; None if there is none."""
        if self._pushes[name] >= MAX_PUSHES:
            return None
        return self._planning.push(name, self._robot.joint_positions())

    def push(self, push: Push) -> None:
        """Push an object, and look where it is."""
        self._pushes[push.name] += 1
        try:
            self._motion.push(push)
        except RobotError as error:
            logger.info("%s was not pushed: %s", push.name, error)
            self._motion.recovery.back_off()
        self._scene.search(push.name)
