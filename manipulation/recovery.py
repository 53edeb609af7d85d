"""What the hand does after a failure: back off, bring back what it holds, return home.

After a failed grasp it is among objects, perhaps with one between the fingers that should not be there; an
object that met something on its way is brought back to the table before anything else is tried.
"""

from __future__ import annotations

import itertools
import logging
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from manipulation.errors import RobotError
from manipulation.free_table import outlines_of_others, roomy_spots
from manipulation.observation import FEWEST_UNKNOWN, SceneObserver
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.robot import Robot
from manipulation.trajectories import JointTrajectory, joint_move, line_postures
from manipulation.types import Grasp, PickPlacePlan
from manipulation.ways_back import DESCENT, planned_way, reversed_way, way_to_room
from manipulation.withdrawal import HOME_MARGINS
from perception.geometry import invert

logger = logging.getLogger(__name__)

_ASIDE = 0.03  # [m] of the hand from where it was to set an object down, or from where it grasped it
_HANGING = 0.08  # [m] around the TCP in which something hangs on the fingers, once they have risen
_CLEAR = 0.04  # [m] by which that is less than the rise: what was not lifted may have moved, and is unknown


class Recovery:
    """Motions of a robot after one that failed; one that is blocked in turn is no error.

    Args:
        robot: the robot.
        planner: planner whose scene follows the objects that are moved.
        observer: looks at the scene.
        config: settings.
    """

    def __init__(
        self, robot: Robot, planner: PickPlacePlanner, observer: SceneObserver, config: ManipulationConfig
    ) -> None:
        self._robot, self._planner, self._observer, self._config = robot, planner, observer, config
        self._scene = planner.scene

    def back_off(self, grasp: Grasp | None = None) -> None:
        """Retreat vertically if that is possible; after a grasp with the fingers as far apart as before it.

        Wider, they would jam a small bowl from inside. An object that is lifted nevertheless is put down
        once, and released with a smaller opening.
        """
        robot = self._robot
        if grasp is not None:
            robot.move_gripper(grasp.opening)
        rise = self._rise()
        if grasp is None or rise is None or not self._something_hangs(rise):
            return
        logger.info("something hangs on the fingers and is put down again")
        try:
            robot.follow(rise.reversed())
        except RobotError as error:
            logger.warning("what hangs on the fingers met something: %s", error)
        robot.move_gripper(0.5 * (grasp.held_width + grasp.opening))
        self._rise()

    def bring_back(self, plan: PickPlacePlan) -> None:
        """Bring an object that met something, and may have turned in the hand, back to the table."""
        planner, robot, margins = self._planner, self._robot, self._config.pick_place.transit_margins
        spots, base = self._places_to_set_down(plan)
        for way_back in (
            partial(way_to_room, spots=spots, base=base, margins=margins),
            reversed_way,
            partial(planned_way, margins=margins),
        ):
            way = way_back(plan, robot.joint_positions(), planner.motions)
            try:
                for motion in way:
                    robot.follow(motion)
            except RobotError as error:
                logger.warning("%s was not brought back: %s", plan.name, error)
            if way and self._is_over(way[-1].positions[-1]):
                self._note_set_down(plan)
                return

    def go_home(self) -> None:
        """Return to the home posture, over waypoints if necessary.

        Where no path is known to be free, over a point above the hand: the direct way sweeps the table.
        """
        robot, motions = self._robot, self._planner.motions
        q, home = robot.joint_positions(), np.asarray(robot.arm.q_home, dtype=np.float64)
        if np.abs(q - home).max() < 1e-3:
            return
        path = motions.any_path(q, home, robot.gripper_width(), (None, *HOME_MARGINS))
        if path is None:
            direct, *others = itertools.islice(motions.candidate_paths(q, home), 2)
            path = others[0] if others else direct
        try:
            for start, goal in itertools.pairwise(path):
                robot.follow(joint_move(start, goal, motions.limits))
        except RobotError as error:
            logger.warning("return to the home posture was blocked: %s", error)

    def _rise(self) -> JointTrajectory | None:
        """Move the hand straight up; return the motion, or None if it was not possible."""
        robot, planner = self._robot, self._planner
        q = robot.joint_positions()
        T_up = planner.kinematics.forward(q)
        for height in (0.15, 0.08):
            T_goal = T_up.copy()
            T_goal[2, 3] += height
            postures = line_postures(planner.kinematics, q, T_goal, planner.motions.config)
            if postures is None:
                continue
            rise = planner.motions.time_line(postures)
            try:
                robot.follow(rise)
            except RobotError as error:
                logger.warning("retreat after a failed grasp was blocked: %s", error)
                return None
            return rise
        return None

    def _something_hangs(self, rise: JointTrajectory) -> bool:
        """Return whether an image shows something unknown between or beside the fingers after a rise."""
        forward = self._planner.kinematics.forward
        before, now = (forward(rise.positions[k])[:3, 3] for k in (0, -1))
        reach = min(_HANGING, float((now - before)[2]) - _CLEAR)

        def is_near(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
            return np.linalg.norm(points - now, axis=1) < reach

        unknown = self._observer.unexpected(self._scene.poses(), self._scene.perceived_obstacles, is_near)
        return len(unknown) >= FEWEST_UNKNOWN

    def _places_to_set_down(self, plan: PickPlacePlan) -> tuple[list[tuple[float, float]], float]:
        """Return spots with room for an object however it is turned, and the height [m] of its base now."""
        scene, forward = self._scene, self._planner.kinematics.forward
        T, vertices = scene.pose(plan.name), scene.items[plan.name].vertices
        reach = np.linalg.norm(vertices - plan.grasp.T_stand_tcp[:3, 3], axis=1).max()
        moved = {plan.name, *plan.contents}
        others = outlines_of_others(scene.items, scene.poses(), scene.perceived_obstacles, moved)
        x, y, _ = forward(plan.lift.positions[0])[:3, 3]
        spots = roomy_spots((float(x), float(y)), float(reach), others, self._config.free_area)
        return spots, float((vertices @ T[2, :3]).min() + T[2, 3])

    def _is_over(self, q: Float[np.ndarray, "n"]) -> bool:
        """Return whether the hand is where a posture has it, or could not be lowered as far."""
        forward = self._planner.kinematics.forward
        apart = (forward(self._robot.joint_positions()) - forward(q))[:3, 3]
        return bool(np.linalg.norm(apart[:2]) < _ASIDE and apart[2] < DESCENT)

    def _note_set_down(self, plan: PickPlacePlan) -> None:
        """Expect an object where the hand has brought it, as if it had not turned."""
        forward = self._planner.kinematics.forward
        T_grasped, T_now = map(forward, (plan.lift.positions[0], self._robot.joint_positions()))
        if np.linalg.norm((T_now - T_grasped)[:3, 3]) > _ASIDE:
            for name in (plan.name, *plan.contents):
                self._scene.moved(name, T_now @ invert(T_grasped) @ self._scene.pose(name))
