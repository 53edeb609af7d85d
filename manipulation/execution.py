"""Task execution as a closed loop: look, grasp, transfer, place, and look again.

An object is looked for where it is expected before the fingers close around it and after its release; the
width between the fingers shows whether it is held. Whatever is not as expected is searched for and planned
again from where it is: a grasp is retried with another one, a lying object is first set upright.
"""

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
from manipulation.lying_grasps import is_upside_down, lies, upright_goals
from manipulation.observation import NoObserver, SceneObserver, classify_grip, is_displaced
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.robot import Robot
from manipulation.trajectories import joint_move, line_postures
from manipulation.types import Grasp, ObjectOutcome, PickPlacePlan, Placement, StandingObject, TaskPlan
from perception.obstacles.obstacle import PerceivedObstacle

logger = logging.getLogger(__name__)

MISPLACED = 0.02  # [m] from its goal, from which on a released object is grasped again
_UPRIGHT_GOALS = 6  # spots that are tried for an object to be set upright

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


OnEvent = Callable[[TaskEvent], None]


class _GraspFailed(Exception):
    """The hand closed without holding the object, or the object was lost."""


class _SceneChanged(Exception):
    """The object is not where the plan expects it; nothing was touched."""


def execute(
    task: TaskPlan,
    robot: Robot,
    observer: SceneObserver | None = None,
    on_event: OnEvent | None = None,
    config: ManipulationConfig = ManipulationConfig(),
    kinematics: Kinematics | None = None,
) -> list[ObjectOutcome]:
    """Place the objects of a task one by one, in its order unless one is blocked.

    An object without a feasible plan is deferred until others have been moved. After a failed grasp, other
    grasps are tried up to ``config.max_retries`` times. An object that was not placed is searched for and
    tried again once all others are done.

    Args:
        task: goals in order.
        robot: robot that executes the motions.
        observer: looks at the scene; without it, only the width between the fingers is checked.
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
    return _Execution(task, robot, planner, config, observer or NoObserver(), on_event).run()


class _Execution:
    """State of one execution: the planner with its collision world, and the outcomes so far."""

    def __init__(
        self,
        task: TaskPlan,
        robot: Robot,
        planner: PickPlacePlanner,
        config: ManipulationConfig,
        observer: SceneObserver,
        on_event: OnEvent | None,
    ) -> None:
        self.task, self.robot, self.planner, self.config = task, robot, planner, config
        self.observer = observer
        self.on_event = on_event or (lambda event: None)
        self.outcomes: dict[str, ObjectOutcome] = {}
        self._tried_before: dict[str, ObjectOutcome] = {}  # first outcomes of objects that get another chance
        self._missing: set[str] = set()

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
            if outcome.attempts == 0 and not last_chance and placement.name not in self._missing:
                self._notify("deferred", placement.name, outcome.reason)
                queue.append(placement)
                n_deferred += 1
                continue
            n_deferred = 0
            if self._gets_another_chance(placement, outcome):
                self._notify("deferred", placement.name, outcome.reason)
                queue.append(placement)
                continue
            self.outcomes[placement.name] = outcome
            self._notify("placed" if outcome.placed else "failed", placement.name, outcome.reason)
        with contextlib.suppress(RobotStoppedError):
            self._go_home()
        return list(self.outcomes.values())

    def _gets_another_chance(self, placement: Placement, outcome: ObjectOutcome) -> bool:
        """Return whether an object that was not placed is tried once more when the others are done."""
        name = placement.name
        if outcome.placed or name in self._tried_before or isinstance(self.observer, NoObserver):
            return False
        self._tried_before[name] = outcome
        return True

    def _give_up(self, placements: Sequence[Placement], reason: str) -> None:
        """Record that the robot was stopped while it handled the first placement."""
        for index, placement in enumerate(placements):
            name, before = placement.name, self._tried_before.get(placement.name)
            attempts = (before.attempts if before else 0) + (1 if index == 0 else 0)
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
        name, before = placement.name, self._tried_before.get(placement.name)
        number, n_before = self.task.objects[name].id, before.attempts if before else 0
        tried: list[Grasp] = []
        reason, attempts = "", 0
        if before is not None:
            reason = self._search(name)
            if reason:
                return ObjectOutcome(number, name, False, n_before, reason)
        for _ in range(2 * (1 + self.config.max_retries)):
            if attempts > self.config.max_retries:
                break
            self._notify("plan", name)
            try:
                plan = self._plan_next(placement, tried)
            except PlanningError as error:
                reason = f"{reason}; then {error}" if reason else str(error)
                logger.info("%s", error)
                return ObjectOutcome(number, name, False, n_before + attempts, reason)
            try:
                self._execute(plan)
                if plan.placement is placement:
                    return ObjectOutcome(
                        number, name, True, n_before + attempts + 1, "", self.planner.world.pose(name)
                    )
                continue  # set upright, to be grasped from above
            except _SceneChanged as error:
                reason = str(error)
            except (_GraspFailed, RobotError) as error:
                reason = str(error)
                attempts += 1
                tried.append(plan.grasp)
                self._back_off()
            logger.info("%s, attempt %d: %s", name, attempts, reason)
            self._notify("retry", name, reason)
            problem = self._search(name)
            if problem:
                return ObjectOutcome(number, name, False, n_before + attempts, f"{reason}; {problem}")
        return ObjectOutcome(number, name, False, n_before + attempts, reason)

    def _plan_next(self, placement: Placement, tried: Sequence[Grasp]) -> PickPlacePlan:
        """Return the plan that places an object, or that sets it upright if it lies.

        Raises:
            PlanningError: there is none.
        """
        name, q = placement.name, self.robot.joint_positions()
        planner, T_world_stand = self.planner, self.planner.world.pose(name)
        if not lies(T_world_stand):
            return planner.plan(placement, q, tried)
        x, y = T_world_stand[:2, 3]
        how = "stands upside down" if is_upside_down(T_world_stand) else "lies on its side"
        grasps = planner.grasps(name)
        if not grasps.grasps:
            raise PlanningError(f"{name} {how} at ({x:.2f}, {y:.2f}) m: {grasps.failure_message(name)}")
        others = [
            (planner.world.pose(other)[:2, 3], _reach(self.task.objects[other]))
            for other in planner.world.names
            if other != name and other not in self._missing
        ]
        others += [_footprint(obstacle) for obstacle in self.task.obstacles]
        goals = upright_goals(self.task.objects[name], grasps.grasps[0], others, self.config.upright_area)
        last = "no free table to set it upright"
        for goal in itertools.islice(goals, _UPRIGHT_GOALS):
            try:
                return planner.plan(goal, q, tried)
            except PlanningError as error:
                last = str(error)
        raise PlanningError(f"{name} {how} at ({x:.2f}, {y:.2f}) m and cannot be set upright: {last}")

    def _execute(self, plan: PickPlacePlan) -> None:
        """Look, grasp, lift, transfer, place, retreat and look; the grasp is verified after each step.

        Raises:
            _SceneChanged: the object is not where it was expected.
            _GraspFailed: the object is not held, or not where it was released.
            RobotError: the robot failed to execute a motion.
        """
        robot, grasp, name = self.robot, plan.grasp, plan.name
        self._notify("approach", name, plan=plan)
        robot.move_gripper(grasp.opening)
        if plan.transit is not None:
            robot.follow(plan.transit)
        self._require_in_place(name)
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
        self._require_released(plan)

    def _require_in_place(self, name: str) -> None:
        """Raise _SceneChanged if an image from above shows that an object is not where it was expected."""
        if self.observer.glance(self._poses(), (name,)).get(name) == "displaced":
            raise _SceneChanged(f"{name} is not where it was seen before")

    def _require_released(self, plan: PickPlacePlan) -> None:
        """Raise _GraspFailed if a released object is seen elsewhere."""
        name = plan.name
        if self.observer.glance(self._poses(), (name,)).get(name) != "displaced":
            return
        finding = self.observer.find(name, self._poses())
        if finding.T_world_stand is None:
            return  # the final verification judges what cannot be seen from here
        if is_displaced(plan.T_world_stand_rest, finding.T_world_stand, MISPLACED):
            self.planner.moved(name, finding.T_world_stand)
            raise _GraspFailed(f"{name} is not where it was released")

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
        if classify_grip(width, grasp) != "held":
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

    def _search(self, name: str) -> str:
        """Search for an object and update its pose; return why a retry is impossible, or an empty string."""
        finding = self.observer.find(name, self._poses())
        self._missing.discard(name)
        if finding.status == "missing":
            self._missing.add(name)
            self.planner.forget(name)
            return f"{name} is nowhere on the table within view: it was taken away or fell off"
        if finding.T_world_stand is not None:
            self.planner.moved(name, finding.T_world_stand)
        return ""

    def _poses(self) -> dict[str, np.ndarray]:
        """Return the expected T_world_stand of every object that is not missing."""
        world = self.planner.world
        return {name: world.pose(name) for name in world.names if name not in self._missing}

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


def _reach(item: StandingObject) -> float:
    """Return the radius [m] of the circle about an object's axis that holds all of it."""
    return float(np.linalg.norm(item.vertices[:, :2], axis=1).max())


def _footprint(obstacle: PerceivedObstacle) -> tuple[np.ndarray, float]:
    """Return centre (x, y) and radius [m] of a circle that holds the top view of a thing of no class."""
    low, high = obstacle.bounds[:, :2]
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2
