"""Execution of one pick-and-place plan with its checks: look, grasp, lift, transfer, release, look.

The width between the fingers tells whether the object is held; an image from above, whether it is where it
was expected before the grasp and after the release.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from manipulation.errors import RobotError
from manipulation.lying_grasps import lies
from manipulation.observation import SceneObserver, classify_grip, is_displaced, is_turned
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.pressing import LEVEL, PRESSABLE, is_plausible, lean, lowest_leaning, plan_press
from manipulation.pushing import Push
from manipulation.robot import JointTrajectory, Robot
from manipulation.trajectories import concatenate, joint_move, line_postures
from manipulation.types import Grasp, PickPlacePlan
from manipulation.withdrawal import HOME_MARGINS
from perception.geometry import levelled

logger = logging.getLogger(__name__)

MAX_PRESSES = 3  # of a bowl in another; one more for each further bowl below
_RISES = (0.18, 0.12, 0.08, 0.04)  # [m] above where an object met something, tried in order
_RETURNED = 0.05  # [rad] of each joint from the posture of the grasp
_ABOVE = 0.003  # [m] by which the base of an object is above that of one that carries it, at least
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


class GraspFailedError(Exception):
    """The hand closed without holding the object, or the object was lost."""


class LeaningError(GraspFailedError):
    """An object leans in the one that it was put into; its pose in the planner's world is as it was seen."""


class SceneChangedError(Exception):
    """The object is not where the plan expects it; nothing was touched."""


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

    def run(self, plan: PickPlacePlan, looks_first: bool = True) -> None:
        """Look, grasp, lift, transfer, place, retreat and look; the grasp is verified after each step.

        Args:
            plan: the plan.
            looks_first: whether an image must show the object where it is expected before it is touched.

        Raises:
            SceneChangedError: the object is not where it was expected.
            GraspFailedError: the object is not held, not where it was released, or leans there.
            RobotError: the robot failed to execute a motion.
        """
        robot, grasp, name = self.robot, plan.grasp, plan.name
        self._notify("approach", name, plan=plan)
        robot.move_gripper(grasp.opening)
        if plan.transit is not None:
            robot.follow(plan.transit)
        if looks_first:
            self._require_in_place(name)
        robot.follow(plan.approach)
        self._notify("grasp", name)
        robot.move_gripper(0.0)
        self._require_held(grasp, f"no object between the fingers after closing on {name}")
        robot.follow(plan.lift)
        # The closed width is wide enough for an object that shifts between the pads.
        self._require_held(grasp, f"{name} was lost during the lift")
        self._require_alone(plan)
        self._notify("transfer", name)
        try:
            robot.follow(plan.transfer)
        except RobotError:
            self._bring_back(plan)
            raise
        self._notify("place", name)
        self._require_held(grasp, f"{name} was lost during the transfer")
        self._release(plan)
        T_rest_before = plan.T_world_stand_rest @ np.linalg.inv(self.planner.world.pose(name))
        self.planner.moved(name, plan.T_world_stand_rest)
        for inside in plan.contents:
            self.planner.moved(inside, T_rest_before @ self.planner.world.pose(inside))
        self._notify("retreat", name)
        robot.follow(plan.retreat)
        if plan.placement.stack:
            self._settle_in_stack(plan)
        self._require_released(plan)

    def _require_in_place(self, name: str) -> None:
        """Raise SceneChangedError if an image shows that an object is not where it was expected."""
        if self.observer.glance(self.planner.poses(), (name,)).get(name) == "displaced":
            raise SceneChangedError(f"{name} is not where it was seen before")

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
        """Bring an object that met something while it was lowered back to where it was grasped."""
        for motions_back in (self._reversed_way(plan), self._planned_way(plan)):
            try:
                for motion in motions_back:
                    self.robot.follow(motion)
            except RobotError as error:
                logger.warning("%s was not brought back: %s", plan.name, error)
            else:
                if np.abs(self.robot.joint_positions() - plan.lift.positions[0]).max() < _RETURNED:
                    return

    def _reversed_way(self, plan: PickPlacePlan) -> Iterator[JointTrajectory]:
        """Yield motions straight up, and from there back along the transfer; none if that is impossible."""
        q, motions, transfer = self.robot.joint_positions(), self.planner.motions, plan.transfer
        reached = int(np.abs(transfer.positions - q).max(axis=1).argmin())
        is_at_rest = np.abs(transfer.velocities[: reached + 1]).max(axis=1) < 1e-6
        above = int(np.flatnonzero(is_at_rest).max(initial=0))
        T_above = motions.kinematics.forward(transfer.positions[above])
        up = line_postures(motions.kinematics, q, T_above, motions.config) if above > 0 else None
        if up is not None:
            yield motions.time_line(up)
            yield joint_move(up[-1], transfer.positions[above], motions.limits)
            yield concatenate([transfer.until(above).reversed(), plan.lift.reversed()])

    def _planned_way(self, plan: PickPlacePlan) -> Iterator[JointTrajectory]:
        """Yield motions straight up, and from there along a free path; none if there is no such path."""
        motions, grasp = self.planner.motions, plan.grasp
        q = self.robot.joint_positions()
        motions.world.carry(plan.name, np.linalg.inv(grasp.T_stand_tcp))
        margins = self.config.pick_place.transit_margins
        try:
            for height in _RISES:
                T_up = motions.kinematics.forward(q)
                T_up[2, 3] += height
                up = line_postures(motions.kinematics, q, T_up, motions.config)
                if up is None:
                    continue
                path = motions.free_path(up[-1], plan.lift.positions[-1], grasp.held_width, margins)
                if path is not None:
                    break
            else:
                return
        finally:
            motions.world.release()
        yield motions.time_line(up)
        yield motions.time_path(path)
        yield plan.lift.reversed()

    def _settle_in_stack(self, plan: PickPlacePlan) -> None:
        """Look at a bowl in others, follow those that moved, and press level what leans, the lower one first.

        Where the upper one, pressed level, pushes one below it aside, it is not pressed again.

        Raises:
            LeaningError: the upper one leans and cannot be pressed level.
        """
        name, names = plan.name, (plan.name, *reversed(plan.placement.stack))
        has_pushed = False
        for presses in itertools.count():
            before = self.planner.poses()
            seen = self.observer.look_closer(names, before)
            if not is_plausible(seen):
                return
            for other, T_world_stand in seen.items():
                self.planner.moved(other, levelled(T_world_stand, float(before[other][2, 3])))
            leaning = lowest_leaning(names, seen)
            if leaning is None:
                return
            beneath = names[names.index(leaning) + 1]
            in_vain = presses == MAX_PRESSES + len(names) - 2 or (has_pushed and leaning == name)
            if in_vain or lean(seen[leaning]) >= PRESSABLE:
                if name not in seen or lean(seen[name]) < LEVEL:
                    return
                self.planner.moved(name, seen[name])
                self.planner.observe_obstacles(self.planner.perceived_obstacles)  # a bowl below has a cavity
                raise LeaningError(
                    f"{name} leans by {np.rad2deg(lean(seen[name])):.0f} degrees in {names[1]}"
                )
            has_pushed |= presses > 0 and leaning != name
            # Pressed level, it will be over the middle of the one below.
            rest = self.planner.world.pose(beneath).copy()
            rest[2, 3] = before[leaning][2, 3]
            self.planner.moved(leaning, rest)
            self._press(leaning, seen[leaning], frozenset(names), draws=presses > 0)

    def _press(
        self, name: str, T_world_stand: Float[np.ndarray, "4 4"], touched: frozenset[str], draws: bool
    ) -> None:
        """Press a leaning bowl down with the closed hand, as far as it gives, and draw it to the middle."""
        robot, planner = self.robot, self.planner
        motions, item, T_rest = planner.motions, planner.items[name], planner.world.pose(name)
        q = robot.joint_positions()
        ways = (True, False) if draws else (False,)
        presses = (plan_press(motions, item, T_world_stand, T_rest, q, touched, way) for way in ways)
        press = next((found for found in presses if found is not None), None)
        if press is None:
            logger.info("%s leans and cannot be pressed level", name)
            return
        self._notify("place", name, "leans and is pressed level")
        robot.move_gripper(0.0)
        robot.follow(press.transit)
        try:
            robot.follow(press.down)
            if press.draw is not None:
                robot.follow(press.draw)
        except RobotError as error:
            logger.info("%s gives no further: %s", name, error)
            self.back_off()
        else:
            robot.follow(press.up)

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

    def back_off(self) -> None:
        """Open the gripper and retreat vertically if that is possible."""
        robot, planner = self.robot, self.planner
        robot.move_gripper(robot.arm.max_width)
        q = robot.joint_positions()
        T_up = planner.kinematics.forward(q)
        for height in (0.15, 0.08):
            T_goal = T_up.copy()
            T_goal[2, 3] += height
            postures = line_postures(planner.kinematics, q, T_goal, planner.motions.config)
            if postures is not None:
                try:
                    robot.follow(planner.motions.time_line(postures))
                except RobotError as error:
                    logger.warning("retreat after a failed grasp was blocked: %s", error)
                return

    def go_home(self) -> None:
        """Return to the home posture, over waypoints if necessary.

        Where no path is known to be free, over a point above the hand: the direct way sweeps the table.
        """
        robot, motions = self.robot, self.planner.motions
        q, home = robot.joint_positions(), np.asarray(robot.arm.q_home, dtype=np.float64)
        if np.abs(q - home).max() < 1e-3:
            return
        path = motions.free_path(q, home, robot.gripper_width(), (None, *HOME_MARGINS))
        if path is None:
            direct, *others = itertools.islice(motions.candidate_paths(q, home), 2)
            path = others[0] if others else direct
        try:
            for start, goal in itertools.pairwise(path):
                robot.follow(joint_move(start, goal, motions.limits))
        except RobotError as error:
            logger.warning("return to the home posture was blocked: %s", error)
