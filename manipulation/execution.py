"""Task execution as a closed loop: look, grasp, transfer, place, and look again.

An object is looked for where it is expected before the fingers close around it and after its release; the
width between the fingers shows whether it is held. Whatever is not as expected is searched for and planned
again from where it is: a grasp is retried with another one, an object that does not stand is turned.
"""

from __future__ import annotations

import contextlib
import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from manipulation.errors import NoPlanError, PlanningError, RobotError, RobotStoppedError
from manipulation.kinematics import Kinematics
from manipulation.lying_grasps import lies
from manipulation.object_planning import Effort, ObjectPlanning
from manipulation.observation import Finding, NoObserver, SceneObserver, is_displaced
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.pick_place import PickPlacePlanner
from manipulation.plan_execution import (
    MISPLACED,
    GraspFailedError,
    LeaningError,
    Phase,
    PlanExecution,
    SceneChangedError,
)
from manipulation.planner import ManipulationConfig
from manipulation.robot import Robot
from manipulation.types import Grasp, ObjectOutcome, PickPlacePlan, Placement, TaskPlan
from manipulation.withdrawal import Withdrawal, WithdrawingObserver

logger = logging.getLogger(__name__)

BESIDE = 0.15  # [m] between the axes of a moved object and of those that it may have pushed


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


def execute(
    task: TaskPlan,
    robot: Robot,
    observer: SceneObserver | None = None,
    on_event: OnEvent | None = None,
    config: ManipulationConfig = ManipulationConfig(),
    kinematics: Kinematics | None = None,
) -> list[ObjectOutcome]:
    """Place the objects of a task one by one, in its order unless one is blocked.

    An object without a feasible plan is deferred until others have been moved; if all are, more effort is
    made (``Effort``). After a failed grasp, other grasps are tried up to ``config.max_retries`` times. An
    object that was not placed is searched for and tried again once all others are done.

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
        self.withdrawal = Withdrawal(robot, planner)
        self.can_see = not isinstance(observer, NoObserver)
        self.observer = WithdrawingObserver(observer, self.withdrawal) if self.can_see else observer
        self.on_event = on_event or (lambda event: None)
        self.motion = PlanExecution(robot, planner, self.observer, config, self._notify)
        self.planning = ObjectPlanning(task, planner, config)
        self.outcomes: dict[str, ObjectOutcome] = {}
        self._queue = deque(task.placements)
        self._to_place = {placement.name for placement in task.placements}
        self._set_aside: set[str] = set()
        self._blockers: dict[str, Sequence[str]] = {}  # of objects that had no plan
        self._made_way: set[tuple[str, str]] = set()  # objects and those that were moved before them
        self._located: set[str] = set()  # objects that were found since they were knocked over
        self._tried_before: dict[str, ObjectOutcome] = {}  # first outcomes of objects that get another chance

    def run(self) -> list[ObjectOutcome]:
        queue = self._queue
        effort, n_deferred = Effort.PLAIN, 0  # with this effort, in a row
        while queue:
            placement = queue.popleft()
            try:
                outcome = self._attempt(placement, effort)
            except RobotStoppedError as error:
                self._give_up([placement, *queue], str(error))
                return list(self.outcomes.values())
            if outcome is None:
                if effort == Effort.PLAIN and self._make_way(placement):
                    n_deferred = 0
                    continue
                queue.append(placement)
                n_deferred += 1
                if n_deferred == len(queue):
                    effort, n_deferred = Effort(effort + 1), 0
                continue
            if outcome.attempts or outcome.name in self.planner.forgotten:
                effort, n_deferred = Effort.PLAIN, 0
            if self._gets_another_chance(placement, outcome):
                self._notify("deferred", placement.name, outcome.reason)
                queue.append(placement)
                continue
            self.outcomes[placement.name] = outcome
            self._notify("placed" if outcome.placed else "failed", placement.name, outcome.reason)
            self._put_unblocked_first(outcome.name)
        with contextlib.suppress(RobotStoppedError):
            self.withdrawal.leave()
            self.motion.go_home()
        return list(self.outcomes.values())

    def _attempt(self, placement: Placement, effort: Effort) -> ObjectOutcome | None:
        """Try to place one object; return None if it is deferred."""
        if self._waits_for_stack(placement) and effort < Effort.CLEARING:
            self._blockers[placement.name] = placement.stack
            return None
        outcome = self._place(self._with_placed_stack(placement), effort)
        is_unplanned = outcome.attempts == 0 and placement.name not in self.planner.forgotten
        if is_unplanned and effort < Effort.CLEARING:
            self._notify("deferred", placement.name, outcome.reason)
            return None
        return outcome

    def _put_unblocked_first(self, moved: str) -> None:
        """Put those first that an object blocked before it was moved.

        They are next in the task's order, and what comes later may block their goals.
        """
        in_order = sorted(self._queue, key=lambda p: moved not in self._blockers.get(p.name, ()))
        self._queue.clear()
        self._queue.extend(in_order)

    def _make_way(self, placement: Placement) -> bool:
        """Put first what is most in an object's way and waits too, and then the object; return whether it is.

        The layout is free in its order. An object waits if its place is not enclosed by then,
        what is in its way comes first if it encloses no place of those before it, and is else set aside.
        """
        name, waiting = placement.name, list(self._queue)
        blocker = next(iter(self._blockers.get(name, ())), "")
        goal = next((goal for goal in waiting if goal.name == blocker), None)
        if goal is None or (name, blocker) in self._made_way:
            return False
        earlier = [placement, *waiting[: waiting.index(goal)]]
        is_in_stack = blocker in placement.stack or name in goal.stack
        if is_in_stack or self.planner.can_place_after(placement, [*earlier[1:], goal]):
            return False
        self._made_way.add((name, blocker))
        encloses = any(not self.planner.can_place_after(other, [goal]) for other in earlier)
        if not encloses and not self._waits_for_stack(goal):
            self._queue.remove(goal)
            self._queue.extendleft((placement, goal))
            return True
        if self._clear(name, [blocker]):
            self._queue.appendleft(placement)
            return True
        return False

    def _gets_another_chance(self, placement: Placement, outcome: ObjectOutcome) -> bool:
        """Return whether an object that was not placed is tried once more when the others are done."""
        name = placement.name
        if outcome.placed or name in self._tried_before or not self.can_see:
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
        return any(name in self._to_place and name not in self.outcomes for name in placement.stack)

    def _with_placed_stack(self, placement: Placement) -> Placement:
        """Return the placement with its stack reduced to the bowls that were placed, at the uppermost one."""
        if not placement.stack:
            return placement
        stack = tuple(name for name in placement.stack if self._is_there(name))
        if not stack:
            return replace(placement, stack=(), release_height=self.config.packing.release_height)
        # The bowl below may have moved when it was released or pressed.
        x, y = self.planner.poses()[stack[-1]][:2, 3]
        return replace(placement, stack=stack, position=(float(x), float(y), placement.position[2]))

    def _is_there(self, name: str) -> bool:
        """Return whether a bowl was placed, or was in the box before."""
        return name not in self._to_place or (name in self.outcomes and self.outcomes[name].placed)

    def _place(self, placement: Placement, effort: Effort) -> ObjectOutcome:
        """Try to place one object; the outcome has 0 attempts if there is no plan for the first."""
        name, before = placement.name, self._tried_before.get(placement.name)
        number, n_before = self.task.objects[name].id, before.attempts if before else 0
        tried: list[Grasp] = []
        reason, attempts = "", 0
        is_located = name in self._located
        self._located.discard(name)
        if (before is not None and not is_located) or name in self.planner.forgotten:
            reason = self._search(name)
            if reason:
                return ObjectOutcome(number, name, False, n_before, reason)
        for _ in range(2 * (1 + self.config.max_retries)):
            is_known = False
            if attempts > self.config.max_retries:
                break
            self._notify("plan", name)
            self.withdrawal.leave()
            is_turned = lies(self.planner.world.pose(name))
            try:
                plan = self._plan(placement, tried, effort)
            except PlanningError as error:
                reason = f"{reason}; then {error}" if reason else str(error)
                self._blockers[name] = error.blockers if isinstance(error, NoPlanError) else ()
                logger.info("%s", error)
                return ObjectOutcome(number, name, False, n_before + attempts, reason)
            try:
                self.motion.run(plan)
                self._look_beside(plan)
                if plan.placement is placement or not is_turned:
                    T = self.planner.world.pose(name)
                    return ObjectOutcome(number, name, True, n_before + attempts + 1, "", T)
                continue  # turned, to be grasped again
            except SceneChangedError as error:
                reason = str(error)
            except (GraspFailedError, RobotError) as error:
                reason, is_known = str(error), isinstance(error, LeaningError)
                if is_known:  # the box becomes fuller
                    effort = max(effort, Effort.FLEXIBLE)
                attempts += 1
                tried.append(plan.grasp)
                self.motion.back_off()
                self._look_beside(plan)
            logger.info("%s, attempt %d: %s", name, attempts, reason)
            self._notify("retry", name, reason)
            problem = "" if is_known else self._search(name)
            if problem:
                return ObjectOutcome(number, name, False, n_before + attempts, f"{reason}; {problem}")
        return ObjectOutcome(number, name, False, n_before + attempts, reason)

    def _look_beside(self, plan: PickPlacePlan) -> None:
        """Follow what an object has pushed or knocked over; what was placed is placed again if need be."""
        poses = self.planner.poses()
        T = poses.get(plan.name, plan.T_world_stand_rest)
        below = {plan.name, *plan.placement.stack}
        beside = tuple(
            name
            for name, T_other in poses.items()
            if name not in below and np.linalg.norm((T_other - T)[:2, 3]) < BESIDE
        )
        for name, presence in self.observer.glance(poses, beside).items() if beside else ():
            if presence != "displaced":
                continue
            outcome = self.outcomes.get(name)
            if self._find(name).T_world_stand is None or outcome is None or not outcome.placed:
                continue  # what is not found is judged by the final verification, or searched for in its turn
            if self._is_in_place(name, poses[name]):
                continue
            reason = f"{name} was moved by {plan.name}"
            moved = replace(outcome, placed=False, reason=reason, T_world_stand=None)
            placement = next(p for p in self.task.placements if p.name == name)
            if self._gets_another_chance(placement, moved):
                self._notify("deferred", name, reason)
                del self.outcomes[name]
                self._located.add(name)
                self._queue.appendleft(placement)  # what comes later may block its way
            else:
                self._notify("failed", name, reason)
                self.outcomes[name] = moved

    def _is_in_place(self, name: str, T_before: Float[np.ndarray, "4 4"]) -> bool:
        """Return whether a placed object that was moved still stands in the box; without one, at its goal."""
        T, box = self.planner.world.pose(name), self.task.box
        if box is None:
            return not is_displaced(T_before, T, MISPLACED)
        return not lies(T) and box.contains(T)

    def _plan(self, placement: Placement, tried: Sequence[Grasp], effort: Effort) -> PickPlacePlan:
        """Return the next plan for an object, after what blocks it was set aside if that helps.

        Raises:
            PlanningError: there is none.
        """
        while True:
            try:
                return self.planning.next_plan(placement, self.robot.joint_positions(), tried, effort)
            except NoPlanError as error:
                names = [
                    *(blocker for blocker in error.blockers if blocker != placement.name),
                    placement.name,
                ]
                if effort < Effort.CLEARING or not self._clear(placement.name, names):
                    raise

    def _clear(self, name: str, names: Sequence[str]) -> bool:
        """Set one of several objects aside for another one, or that one itself; return whether one was moved.

        Each is set aside at most once. The object itself comes last: between its neighbours it may only be
        held with a hand that does not fit its goal, and on free table from all sides. What was placed already
        is placed again afterwards; what was in the box before stays there.

        Args:
            name: the object that has no plan.
            names: objects that may be set aside, in descending order of preference.
        """
        placements = {p.name: p for p in self.task.placements if p.name in self.outcomes}
        covered = {below for placement in placements.values() for below in placement.stack}
        movable = self._beside_box() - self._set_aside - covered
        for plan in self.planning.plans_aside(names, movable, self.robot.joint_positions()):
            self._set_aside.add(plan.name)
            reason = "its neighbours block its way" if plan.name == name else f"it blocks {name}"
            self._notify("aside", plan.name, reason)
            if self.outcomes.pop(plan.name, None) is not None:
                self._queue.append(placements[plan.name])
            try:
                self.motion.run(plan)
            except (SceneChangedError, GraspFailedError, RobotError) as error:
                logger.info("%s was not set aside: %s", plan.name, error)
                if not isinstance(error, SceneChangedError):
                    self.motion.back_off()
                self._search(plan.name)
            return True
        return False

    def _beside_box(self) -> set[str]:
        """Return the names of the objects with a goal, and of those that are not in the box."""
        poses, box = self.planner.poses(), self.task.box
        in_box = {name for name, T in poses.items() if box is not None and box.contains(T)}
        return set(poses) - (in_box - self._to_place)

    def _search(self, name: str) -> str:
        """Search for an object and update the scene; return why a retry is impossible, or an empty string."""
        finding = self._find(name)
        if finding.status == "missing":
            self.planner.forget(name)
            return f"{name} is nowhere on the table within view: it was taken away or fell off"
        if finding.T_world_stand is None and name in self.planner.forgotten:
            return f"{name} is nowhere within view, as before"
        return ""

    def _find(self, name: str) -> Finding:
        """Search for an object; update its pose and the things of no class as far as they were seen."""
        finding = self.observer.find(name, self.planner.poses())
        if finding.obstacles is not None:
            self.planner.observe_obstacles(finding.obstacles)
        if finding.T_world_stand is not None:
            self.planner.moved(name, finding.T_world_stand)
        return finding

    def _notify(self, phase: Phase, name: str, message: str = "", plan: PickPlacePlan | None = None) -> None:
        total = len(self.task.placements)
        candidates = tuple(self.planner.grasps(name).grasps) if plan else ()
        self.on_event(TaskEvent(phase, name, len(self.outcomes), total, message, plan, candidates))
