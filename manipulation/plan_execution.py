"""Execution of one pick-and-place plan with its checks: look, grasp, lift, transfer, release, look.

The width between the fingers tells whether the object is held; an image from above, whether it is where it
was expected before the grasp and after the release.
"""

from __future__ import annotations

import itertools
import logging
from functools import partial
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from manipulation.errors import (
    ApproachBlockedError,
    GoalBlockedError,
    GraspFailedError,
    RobotError,
    SceneChangedError,
    UnknownInTheWayError,
)
from manipulation.free_table import outlines_of_others, roomy_spots
from manipulation.hand_collision import HandBoxes, HandClearance
from manipulation.lying_grasps import lies
from manipulation.observation import SceneObserver, classify_grip, is_displaced, is_turned
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.pushing import Push
from manipulation.robot import Robot, follow_opening
from manipulation.stack_settling import StackSettling
from manipulation.trajectories import JointTrajectory, joint_move, line_postures
from manipulation.types import Grasp, PickPlacePlan
from manipulation.ways_back import DESCENT, planned_way, reversed_way, way_to_room
from manipulation.withdrawal import HOME_MARGINS
from perception.geometry import invert, transform_points

logger = logging.getLogger(__name__)

_ASIDE = 0.03  # [m] of the hand from where it was to set an object down, or from where it grasped it
_ABOVE = 0.003  # [m] by which the base of an object is above that of one that carries it, at least
_INSIDE = 0.004  # [m] by which a point is in the way of the hand at least, which covers noise
_UNKNOWN = 60  # measured points that nothing known explains are a thing
_HANGING = 0.08  # [m] around the TCP in which something hangs on the fingers, once they have risen
_CLEAR = 0.04  # [m] by which that is less than the rise: what was not lifted may have moved, and is unknown
_SLIP = 0.005  # [m] by which the fingers close further during the lift, from which on they lose an object
MISPLACED = 0.02  # [m] from its goal, from which on a released object is grasped again

Phase = Literal[
    "plan",
    "approach",
    "grasp",
    "transfer",
    "place",
    "retreat",
    "aside",
    "push",
    "placed",
    "retry",
    "deferred",
    "failed",
]


@runtime_checkable
class Notify(Protocol):
    """Receives the phase that begins."""

    def __call__(
        self, phase: Phase, name: str, message: str = "", plan: PickPlacePlan | None = None
    ) -> None: ...


class PlanExecution:
    """Executes plans on a robot and checks each step.

    Args:
        robot: the robot.
        planner: planner whose collision world follows the objects that are moved.
        observer: looks at the scene.
        config: settings.
        notify: receives the phases.
    """

    def __init__(
        self,
        robot: Robot,
        planner: PickPlacePlanner,
        observer: SceneObserver,
        config: ManipulationConfig,
        notify: Notify,
    ) -> None:
        self.robot, self.planner, self.observer, self.config = robot, planner, observer, config
        self._notify = notify
        self._settling = StackSettling(
            robot, planner, observer, self.back_off,
            lambda name: notify("place", name, "leans and is pressed level"),
        )  # fmt: skip

    def run(self, plan: PickPlacePlan, looks_first: bool = True) -> None:
        """Look, grasp, lift, transfer, place, retreat and look; the grasp is verified after each step.

        Args:
            plan: the plan.
            looks_first: whether an image must show the object where it is expected before it is touched.

        Raises:
            SceneChangedError: the object is not where it was expected.
            UnknownInTheWayError: an image shows something unknown where the hand was about to go.
            ApproachBlockedError: the hand met something on its way to the object.
            GraspFailedError: the object is not held, slips between the fingers, is not where it was released,
                or leans there.
            GoalBlockedError: the object met something on its way to the goal.
            RobotError: the robot failed to execute another motion.
        """
        robot, grasp, name = self.robot, plan.grasp, plan.name
        self._notify("approach", name, plan=plan)
        try:
            if plan.transit is None:
                robot.move_gripper(grasp.opening)
            else:
                follow_opening(robot, plan.transit, grasp.opening)
            if looks_first:
                self._require_in_place(name)
            self._require_free_way(plan)
            robot.follow(plan.approach)
        except RobotError as error:
            raise ApproachBlockedError(str(error)) from error
        self._notify("grasp", name)
        robot.move_gripper(0.0)
        self._require_held(grasp, f"no object between the fingers after closing on {name}")
        closed = robot.gripper_width()
        robot.follow(plan.lift)
        # The closed width is wide enough for an object that shifts between the pads.
        self._require_held(grasp, f"{name} was lost during the lift")
        self._require_firm(plan, closed)
        self._require_alone(plan)
        self._notify("transfer", name)
        try:
            robot.follow(plan.transfer)
        except RobotError as error:
            self._bring_back(plan)
            raise GoalBlockedError(str(error)) from error
        self._notify("place", name)
        self._require_held(grasp, f"{name} was lost during the transfer")
        self._release(plan)
        for moved, T in plan.poses_after(self.planner.poses()).items():
            self.planner.moved(moved, T)
        self._notify("retreat", name)
        robot.follow(plan.retreat)
        if plan.placement.stack:
            self._settling.settle(plan)
        self._require_released(plan)

    def _require_in_place(self, name: str) -> None:
        """Raise SceneChangedError if an image shows that an object is not where it was expected."""
        if self.observer.glance(self.planner.poses(), (name,)).get(name) == "displaced":
            raise SceneChangedError(f"{name} is not where it was seen before")

    def _require_free_way(self, plan: PickPlacePlan) -> None:
        """Raise UnknownInTheWayError if an image shows something where the hand is about to go.

        The neck of a bottle that was taken for its body alone, for instance, is above what the hand avoids.
        """
        planner, gripper = self.planner, self.robot.arm.gripper
        T_first, T_grasp = (planner.kinematics.forward(plan.approach.positions[k]) for k in (0, -1))
        boxes = HandBoxes.of(gripper, plan.grasp.opening, HandClearance().hand_length)
        boxes = boxes.moved(gripper.pads_middle(plan.grasp.opening))
        back = T_grasp[:3, :3].T @ (T_first - T_grasp)[:3, 3]

        def is_on_the_way(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
            return boxes.swept(transform_points(invert(T_grasp), points), back, -_INSIDE)

        unknown = self.observer.unexpected(planner.poses(), planner.perceived_obstacles, is_on_the_way)
        if len(unknown) >= _UNKNOWN:
            x, y, z = np.median(unknown, axis=0)
            raise UnknownInTheWayError(
                f"something unknown at ({x:.2f}, {y:.2f}, {z:.2f}) m is in the way of the hand to {plan.name}"
            )

    def _require_released(self, plan: PickPlacePlan) -> None:
        """Raise GraspFailedError if a released object is seen elsewhere, or a mug is seen turned."""
        name = plan.name
        if self.observer.glance(self.planner.poses(), (name,)).get(name) != "displaced":
            return
        finding = self.observer.find(name, self.planner.poses())
        if finding.T_world_stand is None:
            return  # the final verification judges what cannot be seen from here
        self.planner.moved(name, finding.T_world_stand)
        if is_displaced(plan.T_world_stand_rest, finding.T_world_stand, MISPLACED):
            raise GraspFailedError(f"{name} is not where it was released")
        is_mug = self.planner.items[name].category == "mug" and not lies(finding.T_world_stand)
        if is_mug and is_turned(plan.T_world_stand_rest, finding.T_world_stand):
            raise GraspFailedError(f"{name} was turned when it was released")

    def _require_firm(self, plan: PickPlacePlan, closed: float) -> None:
        """Lower an object again, and raise GraspFailedError, if the fingers went on closing as it was lifted.

        Pads that hold it at the very edge, or beside the middle of a round body, squeeze it out.

        Args:
            plan: the plan, after its lift.
            closed: width at which the fingers had closed, in [m].
        """
        slip = closed - self.robot.gripper_width()
        if slip > _SLIP:
            self.robot.follow(plan.lift.reversed())
            raise GraspFailedError(f"{plan.name} slips between the fingers ({1e3 * slip:.0f} mm in the lift)")

    def _require_alone(self, plan: PickPlacePlan) -> None:
        """Lower an object again, and raise GraspFailedError, if what it stood in or on was lifted with it.

        A bowl that is pinched at its rim may jam in the mug below, whose collision geometry the transfer does
        not have.
        """
        below = self._carriers(plan)
        if not below:
            return
        kinematics, positions = self.planner.kinematics, plan.lift.positions
        lift = kinematics.forward(positions[-1]) @ np.linalg.inv(kinematics.forward(positions[0]))
        poses = dict(self.planner.poses())
        for name in (plan.name, *plan.contents, *below):
            poses[name] = lift @ poses[name]
        seen = self.observer.glance(poses, below)
        stuck = [name for name in below if seen.get(name) == "in_place"]
        if stuck:
            self.robot.follow(plan.lift.reversed())
            raise GraspFailedError(f"{' and '.join(stuck)} was lifted with {plan.name}")

    def _carriers(self, plan: PickPlacePlan) -> tuple[str, ...]:
        """Return the names of the objects in or on which an object of a plan stands."""
        poses, items = self.planner.poses(), self.planner.items
        place = poses[plan.name][:3, 3]

        def is_below(name: str) -> bool:
            apart = poses[name][:3, 3] - place
            outline = np.linalg.norm(items[name].vertices[:, :2], axis=1).max()
            return bool(apart[2] < -_ABOVE and np.linalg.norm(apart[:2]) < outline)

        return tuple(name for name in poses if is_below(name))

    def _bring_back(self, plan: PickPlacePlan) -> None:
        """Bring an object that met something, and may have turned in the hand, back to the table."""
        planner, robot, margins = self.planner, self.robot, self.config.pick_place.transit_margins
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

    def _places_to_set_down(self, plan: PickPlacePlan) -> tuple[list[tuple[float, float]], float]:
        """Return spots with room for an object however it is turned, and the height [m] of its base now."""
        planner = self.planner
        T, vertices = planner.world.pose(plan.name), planner.items[plan.name].vertices
        reach = np.linalg.norm(vertices - plan.grasp.T_stand_tcp[:3, 3], axis=1).max()
        others = outlines_of_others(
            planner.items, planner.poses(), planner.perceived_obstacles, {plan.name, *plan.contents}
        )
        x, y, _ = planner.kinematics.forward(plan.lift.positions[0])[:3, 3]
        spots = roomy_spots((float(x), float(y)), float(reach), others, self.config.free_area)
        return spots, float((vertices @ T[2, :3]).min() + T[2, 3])

    def _is_over(self, q: Float[np.ndarray, "n"]) -> bool:
        """Return whether the hand is where a posture has it, or could not be lowered as far."""
        forward = self.planner.kinematics.forward
        apart = (forward(self.robot.joint_positions()) - forward(q))[:3, 3]
        return bool(np.linalg.norm(apart[:2]) < _ASIDE and apart[2] < DESCENT)

    def _note_set_down(self, plan: PickPlacePlan) -> None:
        """Expect an object where the hand has brought it, as if it had not turned."""
        planner = self.planner
        T_grasped, T_now = map(
            planner.kinematics.forward, (plan.lift.positions[0], self.robot.joint_positions())
        )
        if np.linalg.norm((T_now - T_grasped)[:3, 3]) > _ASIDE:
            for name in (plan.name, *plan.contents):
                planner.moved(name, T_now @ invert(T_grasped) @ planner.world.pose(name))

    def push(self, push: Push) -> None:
        """Push an object along the table with the closed hand; its pose is as expected then.

        Raises:
            RobotError: the robot failed to execute a motion.
        """
        robot = self.robot
        robot.move_gripper(0.0)
        for motion in (push.transit, push.approach, push.push, push.retreat):
            robot.follow(motion)
        self.planner.moved(push.name, push.T_world_stand)

    def _release(self, plan: PickPlacePlan) -> None:
        """Open the gripper; first loosen it, to lower the pads past a lip or cap or to step aside."""
        robot, gap = self.robot, self.config.pick_place.grasp.release_gap
        held = robot.gripper_width()
        if plan.settle is not None:
            robot.move_gripper(min(held + gap + plan.grasp.stand_off, robot.arm.max_width))
            robot.follow(plan.settle)
        robot.move_gripper(min(max(held + 2 * gap, plan.release_opening), robot.arm.max_width))

    def _require_held(self, grasp: Grasp, message: str) -> None:
        """Raise GraspFailedError if the width between the pads is outside the grasp's range."""
        width = self.robot.gripper_width()
        low, high = grasp.closed_width
        if classify_grip(width, grasp) != "held":
            raise GraspFailedError(
                f"{message} (width {1e3 * width:.1f} mm, expected {1e3 * low:.1f} to {1e3 * high:.1f})"
            )

    def back_off(self, grasp: Grasp | None = None) -> None:
        """Retreat vertically if that is possible; after a grasp with the fingers as far apart as before it.

        Wider, they would jam a small bowl from inside. An object that is lifted nevertheless is put down
        once, and released with a smaller opening.
        """
        robot = self.robot
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

    def _rise(self) -> JointTrajectory | None:
        """Move the hand straight up; return the motion, or None if it was not possible."""
        robot, planner = self.robot, self.planner
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
        planner = self.planner
        before, now = (planner.kinematics.forward(rise.positions[k])[:3, 3] for k in (0, -1))
        reach = min(_HANGING, float((now - before)[2]) - _CLEAR)

        def is_near(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
            return np.linalg.norm(points - now, axis=1) < reach

        unknown = self.observer.unexpected(planner.poses(), planner.perceived_obstacles, is_near)
        return len(unknown) >= _UNKNOWN

    def go_home(self) -> None:
        """Return to the home posture, over waypoints if necessary.

        Where no path is known to be free, over a point above the hand: the direct way sweeps the table.
        """
        robot, motions = self.robot, self.planner.motions
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
