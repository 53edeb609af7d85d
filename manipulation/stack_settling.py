"""Bowls that were put into one another are looked at from close by, and pressed level where they lean."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from manipulation.errors import LeaningError, RobotError
from manipulation.observation import SceneObserver
from manipulation.pick_place import PickPlacePlanner
from manipulation.pressing import (
    LEVEL,
    can_lean,
    is_plausible,
    is_pressable,
    lean,
    lowest_leaning,
    plan_press,
    resting_height,
)
from manipulation.robot import Robot
from manipulation.types import PickPlacePlan
from perception.geometry import levelled

logger = logging.getLogger(__name__)

MAX_PRESSES = 3  # of a bowl in another; one more for each further bowl below


class StackSettling:
    """Settles bowls in those below them.

    Args:
        robot: the robot.
        planner: planner whose scene follows the bowls.
        observer: looks at them.
        back_off: retreats with the hand where a press met resistance.
        on_press: called with the name of each bowl that is pressed.
    """

    def __init__(
        self,
        robot: Robot,
        planner: PickPlacePlanner,
        observer: SceneObserver,
        back_off: Callable[[], None],
        on_press: Callable[[str], None],
    ) -> None:
        self._robot, self._planner, self._observer = robot, planner, observer
        self._scene = planner.scene
        self._back_off, self._on_press = back_off, on_press

    def settle(self, plan: PickPlacePlan) -> None:
        """Look at the bowl that a plan put into others, and press level what leans, the lower one first.

        The planner follows those that moved. Where the upper one, pressed level, pushes one below it aside,
        it is not pressed again.

        Raises:
            LeaningError: the upper one leans and cannot be pressed level.
        """
        name, names = plan.name, (plan.name, *reversed(plan.placement.stack))
        has_pushed = False
        for presses in itertools.count():
            before = self._scene.poses()
            seen = self._observer.look_closer(names, before)
            if not is_plausible(seen):
                return
            heights = {other: resting_height(before[other], T) for other, T in seen.items()}
            for other, T_world_stand in seen.items():
                self._scene.moved(other, levelled(T_world_stand, heights[other]))
            items = self._scene.items
            possible = {n: T for n, T in seen.items() if can_lean(items[n], before[n], T)}
            leaning = lowest_leaning(names, possible)
            if leaning is None:
                return
            beneath = names[names.index(leaning) + 1]
            in_vain = presses == MAX_PRESSES + len(names) - 2 or (has_pushed and leaning == name)
            T_beneath = self._scene.pose(beneath)
            if in_vain or not is_pressable(items[leaning], seen[leaning], items[beneath], T_beneath):
                if name not in seen or lean(seen[name]) < LEVEL:
                    return
                self._scene.moved(name, seen[name])
                # A bowl below has a cavity now.
                self._scene.observe_obstacles(self._scene.perceived_obstacles)
                raise LeaningError(
                    f"{name} leans by {np.rad2deg(lean(seen[name])):.0f} degrees in {names[1]}"
                )
            has_pushed |= presses > 0 and leaning != name
            # Pressed level, it will be over the middle of the one below.
            rest = self._scene.pose(beneath).copy()
            rest[2, 3] = heights[leaning]
            self._scene.moved(leaning, rest)
            self._press(leaning, seen[leaning], frozenset(names), draws=presses > 0)

    def _press(
        self, name: str, T_world_stand: Float[np.ndarray, "4 4"], touched: frozenset[str], draws: bool
    ) -> None:
        """Press a leaning bowl down with the closed hand, as far as it gives, and draw it to the middle."""
        robot, planner = self._robot, self._planner
        motions, item, T_rest = planner.motions, planner.scene.items[name], planner.scene.pose(name)
        q = robot.joint_positions()
        ways = (True, False) if draws else (False,)
        presses = (plan_press(motions, item, T_world_stand, T_rest, q, touched, way) for way in ways)
        press = next((found for found in presses if found is not None), None)
        if press is None:
            logger.info("%s leans and cannot be pressed level", name)
            return
        self._on_press(name)
        robot.move_gripper(0.0)
        robot.follow(press.transit)
        try:
            robot.follow(press.down)
            if press.draw is not None:
                robot.follow(press.draw)
        except RobotError as error:
            logger.info("%s gives no further: %s", name, error)
            self._back_off()
        else:
            robot.follow(press.up)
