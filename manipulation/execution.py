"""Carrying out a task: grasp, check, carry, place; look again and try otherwise when a grasp fails."""

from __future__ import annotations

import itertools
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from manipulation.errors import PlanningError, RobotError
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.robot import Robot
from manipulation.standing import stand
from manipulation.trajectories import joint_move, line_postures
from manipulation.types import Grasp, ObjectOutcome, PickPlacePlan, Placement, TaskPlan
from perception.types import ObjectEstimate

log = logging.getLogger(__name__)

Phase = Literal[
    "plan", "approach", "grasp", "transfer", "place", "retreat", "placed", "retry", "deferred", "failed"
]


@dataclass(frozen=True)
class TaskEvent:
    """Progress for whoever watches.

    Attributes:
        phase: what begins or has happened.
        name: of the object.
        done, total: objects settled so far and in all.
        message: what to tell, or empty.
        plan: the plan about to be carried out, at "approach".
        candidates: the grasps it was chosen from.
    """

    phase: Phase
    name: str
    done: int
    total: int
    message: str = ""
    plan: PickPlacePlan | None = None
    candidates: tuple[Grasp, ...] = ()


LookAgain = Callable[[int], ObjectEstimate | None]
OnEvent = Callable[[TaskEvent], None]


class _GraspFailed(Exception):
    """The hand closed on nothing, or lost what it held; the message says when."""


def execute(
    task: TaskPlan,
    robot: Robot,
    look_again: LookAgain | None = None,
    on_event: OnEvent | None = None,
    config: ManipulationConfig | None = None,
) -> list[ObjectOutcome]:
    """Place the objects of a task one by one, in its order as far as the world allows.

    An object that cannot be planned for now is deferred until others have moved. After a failed grasp
    ``look_again(object id)`` may give a new estimate (None: nothing new); other grasps are then tried, up to
    ``config.max_retries`` times.

    Returns:
        One outcome per placement of the task, in the order in which they were settled.
    """
    return _Execution(task, robot, look_again, on_event, config or ManipulationConfig()).run()


class _Execution:
    """The state of one run: the queue, the planner's world, what became of whom."""

    def __init__(
        self,
        task: TaskPlan,
        robot: Robot,
        look_again: LookAgain | None,
        on_event: OnEvent | None,
        config: ManipulationConfig,
    ) -> None:
        self.task, self.robot, self.config = task, robot, config.suiting(robot.arm)
        self.look_again = look_again or (lambda object_id: None)
        self.on_event = on_event or (lambda event: None)
        self.planner = PickPlacePlanner(robot.arm, task.objects, task.box, self.config.pick_place)
        self.outcomes: dict[str, ObjectOutcome] = {}

    def run(self) -> list[ObjectOutcome]:
        queue = deque(self.task.placements)
        waiting = 0  # placements deferred in a row: once all of them are, nothing can change any more
        while queue:
            placement = queue.popleft()
            last_chance = waiting > len(queue)
            if self._must_wait(placement) and not last_chance:
                queue.append(placement)
                waiting += 1
                continue
            outcome = self._handle(self._on_what_stands(placement))
            if outcome.attempts == 0 and not last_chance:
                self._tell("deferred", placement.name, outcome.reason)
                queue.append(placement)
                waiting += 1
                continue
            waiting = 0
            self.outcomes[placement.name] = outcome
            self._tell("placed" if outcome.placed else "failed", placement.name, outcome.reason)
        self._go_home()
        return list(self.outcomes.values())

    def _must_wait(self, placement: Placement) -> bool:
        """Whether a bowl below it is still to be placed."""
        return any(name not in self.outcomes for name in placement.stack)

    def _on_what_stands(self, placement: Placement) -> Placement:
        """The placement on those bowls of its stack that have really been placed."""
        stack = tuple(
            name for name in placement.stack if name in self.outcomes and self.outcomes[name].placed
        )
        if stack == placement.stack:
            return placement
        height = placement.release_height if stack else self.config.packing.release_height
        return replace(placement, stack=stack, release_height=height)

    def _handle(self, placement: Placement) -> ObjectOutcome:
        """Try to place one object; attempts is 0 if no plan was found at all."""
        name = placement.name
        item = self.task.objects[name]
        tried: list[Grasp] = []
        reason = ""
        for attempt in range(1 + self.config.max_retries):
            self._tell("plan", name)
            try:
                plan = self.planner.plan(placement, self.robot.joint_positions(), tried)
            except PlanningError as error:
                reason = f"{reason}; then {error}" if reason else str(error)
                log.info("%s", error)
                return ObjectOutcome(item.id, name, False, attempt, reason)
            try:
                self._carry_out(plan)
                return ObjectOutcome(item.id, name, True, attempt + 1, "", plan.T_world_stand_rest)
            except (_GraspFailed, RobotError) as error:
                reason = str(error)
                log.info("%s, attempt %d: %s", name, attempt + 1, reason)
            tried.append(plan.grasp)
            self._tell("retry", name, reason)
            self._back_off()
            hopeless = self._look(item.id, name)
            if hopeless:
                return ObjectOutcome(item.id, name, False, attempt + 1, f"{reason}; {hopeless}")
        return ObjectOutcome(item.id, name, False, 1 + self.config.max_retries, reason)

    def _carry_out(self, plan: PickPlacePlan) -> None:
        """Grasp, check, carry, check, place, retreat."""
        robot, grasp, name = self.robot, plan.grasp, plan.name
        self._tell("approach", name, plan=plan)
        robot.move_gripper(grasp.opening)
        robot.follow(plan.approach)
        self._tell("grasp", name)
        robot.move_gripper(0.0)
        self._require_held(grasp, f"nothing between the fingers after closing on {name}")
        robot.follow(plan.lift)
        # An object that settles between the pads changes the width and is still held; letting go drops it.
        self._require_held(grasp, f"{name} was lost while lifting")
        self._tell("transfer", name)
        robot.follow(plan.transfer)
        self._tell("place", name)
        self._require_held(grasp, f"{name} was lost on the way")
        self._let_go(plan)
        self.planner.moved(name, plan.T_world_stand_rest)
        self._tell("retreat", name)
        robot.follow(plan.retreat)

    def _let_go(self, plan: PickPlacePlan) -> None:
        """Loosen the grip, sink past the lip of a bowl that hangs on a pad, then open."""
        robot, gap = self.robot, self.config.pick_place.grasp.release_gap
        held = robot.gripper_width()
        if plan.settle is not None:
            robot.move_gripper(min(held + gap, robot.arm.max_width))
            robot.follow(plan.settle)
        robot.move_gripper(min(max(held + 2 * gap, plan.release_opening), robot.arm.max_width))

    def _require_held(self, grasp: Grasp, message: str) -> None:
        """Raise _GraspFailed if the width between the pads does not fit the grasp."""
        width = self.robot.gripper_width()
        low, high = grasp.closed_width
        if not low <= width <= high:
            raise _GraspFailed(
                f"{message} (width {1e3 * width:.1f} mm, expected {1e3 * low:.1f} to {1e3 * high:.1f})"
            )

    def _back_off(self) -> None:
        """Open, and rise straight up out of the way, if that is possible."""
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
                    robot.follow(planner.motions.timed_line(postures))
                except RobotError as error:
                    log.warning("could not back off: %s", error)
                return

    def _look(self, object_id: int, name: str) -> str:
        """Take over what looking again finds; why trying again is no use, or an empty string."""
        estimate = self.look_again(object_id)
        if estimate is None:
            return ""
        try:
            self.planner.observe(replace(stand(estimate, self.config.support), id=object_id, name=name))
        except PlanningError as error:
            self.planner.forget(name)
            return str(error)
        return ""

    def _go_home(self) -> None:
        """Back to the home posture, over a point high above if need be."""
        robot = self.robot
        q, home = robot.joint_positions(), np.asarray(robot.arm.q_home, dtype=np.float64)
        if np.abs(q - home).max() < 1e-3:
            return
        way = self.planner.motions.free_way(q, home, robot.gripper_width()) or [q, home]
        try:
            for start, goal in itertools.pairwise(way):
                robot.follow(joint_move(start, goal, self.planner.motions.limits))
        except RobotError as error:
            log.warning("could not return home: %s", error)

    def _tell(self, phase: Phase, name: str, message: str = "", plan: PickPlacePlan | None = None) -> None:
        total = len(self.task.placements)
        candidates = tuple(self.planner.grasps(name).grasps) if plan else ()
        self.on_event(TaskEvent(phase, name, len(self.outcomes), total, message, plan, candidates))
