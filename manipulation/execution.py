"""Task execution: grasp, verify the grasp, transfer, place; re-observe and retry after a failed grasp."""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from manipulation.errors import PlanningError, RobotError, RobotStoppedError
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.robot import Robot
from manipulation.standing import to_standing
from manipulation.trajectories import joint_move, line_postures
from manipulation.types import Grasp, ObjectOutcome, PickPlacePlan, Placement, TaskPlan
from perception.types import ObjectEstimate

logger = logging.getLogger(__name__)

Phase = Literal[
    "plan", "approach", "grasp", "transfer", "place", "retreat", "placed", "retry", "deferred", "failed"
]


@dataclass(frozen=True)
class TaskEvent:
    """Progress of an execution.

    Attributes:
        phase: phase that begins, or the outcome of an object.
        name: name of the object.
        done, total: number of placements that are completed and in all.
        message: reason of a retry, a deferral or a failure; else empty.
        plan: plan to be executed, in phase "approach".
        candidates: grasps from which it was chosen.
    """

    phase: Phase
    name: str
    done: int
    total: int
    message: str = ""
    plan: PickPlacePlan | None = None
    candidates: tuple[Grasp, ...] = ()


Reobserve = Callable[[int], ObjectEstimate | None]
OnEvent = Callable[[TaskEvent], None]


class _GraspFailed(Exception):
    """The hand closed without holding the object, or the object was lost."""


def execute(
    task: TaskPlan,
    robot: Robot,
    reobserve: Reobserve | None = None,
    on_event: OnEvent | None = None,
    config: ManipulationConfig = ManipulationConfig(),
    kinematics: Kinematics | None = None,
) -> list[ObjectOutcome]:
    """Place the objects of a task one by one, in its order unless one is blocked.

    An object without a feasible plan is deferred until others have been moved. After a failed grasp, other
    grasps are tried up to ``config.max_retries`` times.

    Args:
        task: goals in order.
        robot: robot that executes the motions.
        reobserve: called after a failed grasp with the object's id; returns a new estimate or None.
        on_event: receives progress.
        config: settings.
        kinematics: kinematics of the robot's arm; built if None.

    Returns:
        One outcome per placement of the task, in the order of completion. Once the robot is stopped, the
        placement that is under way and all further ones have failed with that reason.
    """
    config = config.for_arm(robot.arm)
    kinematics = kinematics or Kinematics(robot.arm, config.pick_place.ik)
    obstacles = (TABLE, *(box_obstacles(task.box) if task.box is not None else ()), *task.obstacles)
    planner = PickPlacePlanner(kinematics, task.objects, obstacles, config.pick_place, task.grasps)
    return _Execution(task, robot, planner, config, _Callbacks(reobserve, on_event)).run()


@dataclass(frozen=True)
class _Callbacks:
    """Optional callbacks of an execution; see ``execute``."""

    reobserve: Reobserve | None
    on_event: OnEvent | None


class _Execution:
    """State of one execution: the planner with its collision world, and the outcomes so far."""

    def __init__(
        self,
        task: TaskPlan,
        robot: Robot,
        planner: PickPlacePlanner,
        config: ManipulationConfig,
        callbacks: _Callbacks,
    ) -> None:
        self.task, self.robot, self.planner, self.config = task, robot, planner, config
        self.reobserve = callbacks.reobserve or (lambda object_id: None)
        self.on_event = callbacks.on_event or (lambda event: None)
        self.outcomes: dict[str, ObjectOutcome] = {}

    def run(self) -> list[ObjectOutcome]:
        queue = deque(self.task.placements)
        n_deferred = 0  # in a row: once all remaining placements are deferred, the scene cannot change
        while queue:
            placement = queue.popleft()
            last_chance = n_deferred > len(queue)
            if self._waits_for_stack(placement) and not last_chance:
                queue.append(placement)
                n_deferred += 1
                continue
            try:
                outcome = self._place(self._with_placed_stack(placement))
            except RobotStoppedError as error:
                self._give_up([placement, *queue], str(error))
                return list(self.outcomes.values())
            if outcome.attempts == 0 and not last_chance:
                self._notify("deferred", placement.name, outcome.reason)
                queue.append(placement)
                n_deferred += 1
                continue
            n_deferred = 0
            self.outcomes[placement.name] = outcome
            self._notify("placed" if outcome.placed else "failed", placement.name, outcome.reason)
        with contextlib.suppress(RobotStoppedError):
            self._go_home()
        return list(self.outcomes.values())

    def _give_up(self, placements: Sequence[Placement], reason: str) -> None:
        """Record that the robot was stopped while it handled the first placement."""
        for index, placement in enumerate(placements):
            name = placement.name
            attempts = 1 if index == 0 else 0
            self.outcomes[name] = ObjectOutcome(self.task.objects[name].id, name, False, attempts, reason)
            self._notify("failed", name, reason)

    def _waits_for_stack(self, placement: Placement) -> bool:
        """Return whether a bowl below it has not been processed."""
        return any(name not in self.outcomes for name in placement.stack)

    def _with_placed_stack(self, placement: Placement) -> Placement:
        """Return the placement with its stack reduced to the bowls that were placed."""
        stack = tuple(
            name for name in placement.stack if name in self.outcomes and self.outcomes[name].placed
        )
        if stack == placement.stack:
            return placement
        height = placement.release_height if stack else self.config.packing.release_height
        return replace(placement, stack=stack, release_height=height)

    def _place(self, placement: Placement) -> ObjectOutcome:
        """Try to place one object; the outcome has 0 attempts if there is no plan for the first."""
        name = placement.name
        item = self.task.objects[name]
        tried: list[Grasp] = []
        reason = ""
        for attempt in range(1 + self.config.max_retries):
            self._notify("plan", name)
            try:
                plan = self.planner.plan(placement, self.robot.joint_positions(), tried)
            except PlanningError as error:
                reason = f"{reason}; then {error}" if reason else str(error)
                logger.info("%s", error)
                return ObjectOutcome(item.id, name, False, attempt, reason)
            try:
                self._execute(plan)
                return ObjectOutcome(item.id, name, True, attempt + 1, "", plan.T_world_stand_rest)
            except (_GraspFailed, RobotError) as error:
                reason = str(error)
                logger.info("%s, attempt %d: %s", name, attempt + 1, reason)
            tried.append(plan.grasp)
            self._notify("retry", name, reason)
            self._back_off()
            problem = self._update_estimate(item.id, name)
            if problem:
                return ObjectOutcome(item.id, name, False, attempt + 1, f"{reason}; {problem}")
        return ObjectOutcome(item.id, name, False, 1 + self.config.max_retries, reason)

    def _execute(self, plan: PickPlacePlan) -> None:
        """Grasp, lift, transfer, place and retreat; the grasp is verified after each of the first three.

        Raises:
            _GraspFailed: the object is not held.
            RobotError: the robot failed to execute a motion.
        """
        robot, grasp, name = self.robot, plan.grasp, plan.name
        self._notify("approach", name, plan=plan)
        robot.move_gripper(grasp.opening)
        robot.follow(plan.approach)
        self._notify("grasp", name)
        robot.move_gripper(0.0)
        self._require_held(grasp, f"no object between the fingers after closing on {name}")
        robot.follow(plan.lift)
        # The closed width is wide enough for an object that shifts between the pads.
        self._require_held(grasp, f"{name} was lost during the lift")
        self._notify("transfer", name)
        robot.follow(plan.transfer)
        self._notify("place", name)
        self._require_held(grasp, f"{name} was lost during the transfer")
        self._release(plan)
        self.planner.moved(name, plan.T_world_stand_rest)
        self._notify("retreat", name)
        robot.follow(plan.retreat)

    def _release(self, plan: PickPlacePlan) -> None:
        """Open the gripper; for a bowl, first loosen it and lower the pads past its lip."""
        robot, gap = self.robot, self.config.pick_place.grasp.release_gap
        held = robot.gripper_width()
        if plan.settle is not None:
            robot.move_gripper(min(held + gap, robot.arm.max_width))
            robot.follow(plan.settle)
        robot.move_gripper(min(max(held + 2 * gap, plan.release_opening), robot.arm.max_width))

    def _require_held(self, grasp: Grasp, message: str) -> None:
        """Raise _GraspFailed if the width between the pads is outside the grasp's range."""
        width = self.robot.gripper_width()
        low, high = grasp.closed_width
        if not low <= width <= high:
            raise _GraspFailed(
                f"{message} (width {1e3 * width:.1f} mm, expected {1e3 * low:.1f} to {1e3 * high:.1f})"
            )

    def _back_off(self) -> None:
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

    def _update_estimate(self, object_id: int, name: str) -> str:
        """Re-observe an object; return the reason why a retry is impossible, or an empty string."""
        estimate = self.reobserve(object_id)
        if estimate is None:
            return ""
        try:
            self.planner.observe(replace(to_standing(estimate, self.config.support), id=object_id, name=name))
        except PlanningError as error:
            self.planner.forget(name)
            return str(error)
        return ""

    def _go_home(self) -> None:
        """Return to the home posture, over waypoints if necessary."""
        robot = self.robot
        q, home = robot.joint_positions(), np.asarray(robot.arm.q_home, dtype=np.float64)
        if np.abs(q - home).max() < 1e-3:
            return
        path = self.planner.motions.free_path(q, home, robot.gripper_width()) or [q, home]
        try:
            for start, goal in itertools.pairwise(path):
                robot.follow(joint_move(start, goal, self.planner.motions.limits))
        except RobotError as error:
            logger.warning("return to the home posture was blocked: %s", error)

    def _notify(self, phase: Phase, name: str, message: str = "", plan: PickPlacePlan | None = None) -> None:
        total = len(self.task.placements)
        candidates = tuple(self.planner.grasps(name).grasps) if plan else ()
        self.on_event(TaskEvent(phase, name, len(self.outcomes), total, message, plan, candidates))
