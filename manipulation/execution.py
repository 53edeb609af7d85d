"""Task execution as a closed loop: look, grasp, transfer, place, and look again.

An object is looked for where it is expected before the fingers close around it and after its release; the
width between the fingers shows whether it is held. Whatever is not as expected is searched for and planned
again from where it is: a grasp is retried with another one, an object that does not stand is turned.
"""

from __future__ import annotations

import contextlib
import logging
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from manipulation.clearing import Clearing
from manipulation.errors import (
    ApproachBlockedError,
    GoalBlockedError,
    GraspFailedError,
    LeaningError,
    NoPlanError,
    PlanningError,
    RobotError,
    RobotStoppedError,
    SceneChangedError,
    UnknownInTheWayError,
)
from manipulation.kinematics import Kinematics
from manipulation.lying_grasps import lies
from manipulation.object_planning import Effort, ObjectPlanning
from manipulation.observation import NoObserver, SceneObserver, is_displaced
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.pick_place import PickPlacePlanner
from manipulation.plan_execution import MISPLACED, OFF_ROW, Phase, PlanExecution
from manipulation.planner import ManipulationConfig
from manipulation.planning_ahead import PlanningAhead
from manipulation.robot import Robot
from manipulation.scene_following import SceneFollowing, Searched
from manipulation.task_order import TaskOrder
from manipulation.task_progress import TaskProgress
from manipulation.types import Grasp, ObjectOutcome, PickPlacePlan, Placement, TaskPlan
from manipulation.withdrawal import Withdrawal, WithdrawingObserver

logger = logging.getLogger(__name__)

_MAX_UNKNOWN = 2  # times that something unknown is in the hand's way to an object, until it is left


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
    ends_home: bool = True,
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
        ends_home: whether the arm returns to its home posture; else the hand rises above the objects.

    Returns:
        One outcome per placement of the task, in the order of completion. Once the robot is stopped, the
        placement that is under way and all further ones have failed with that reason.
    """
    config = config.for_arm(robot.arm)
    kinematics = kinematics or Kinematics(robot.arm, config.pick_place.ik)
    obstacles = (TABLE, *(box_obstacles(task.box) if task.box is not None else ()), *task.obstacles)
    planner = PickPlacePlanner(kinematics, task.objects, obstacles, config.pick_place, task.grasps)
    return _Execution(task, robot, planner, config, observer or NoObserver(), on_event).run(ends_home)


class _Execution:
    """State of one execution: the planner with its collision world, and the progress so far."""

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
        self.scene = planner.scene
        self.withdrawal = Withdrawal(robot, planner)
        self.can_see = not isinstance(observer, NoObserver)
        self.observer = WithdrawingObserver(observer, self.withdrawal) if self.can_see else observer
        self.on_event = on_event or (lambda event: None)
        misplaced = OFF_ROW if task.box is None else MISPLACED
        self.motion = PlanExecution(robot, planner, self.observer, config, self._notify, misplaced)
        self.planning = ObjectPlanning(task, planner, config)
        self._ahead = PlanningAhead(task, planner, config)
        self._order = TaskOrder(task.placements, planner)
        ids = {name: item.id for name, item in task.objects.items()}
        self._progress = TaskProgress(ids, task.placements, config.packing.release_height)
        self._follower = SceneFollowing(self.scene, self.observer)
        self._clearing = Clearing(robot, self.planning, self.motion, self._follower)
        self._located: set[str] = set()  # objects that were found since they were knocked over
        self._blocked: Counter[str] = Counter()  # how often objects met something on the way to their goals
        self._unknown: Counter[str] = Counter()  # how often something unknown was in the hand's way to them

    def run(self, ends_home: bool) -> list[ObjectOutcome]:
        with self._ahead:
            if self._place_all():
                with contextlib.suppress(RobotStoppedError):
                    self.withdrawal.rise()
                    if ends_home:
                        self.motion.recovery.go_home()
        return self._progress.results(self.scene.poses())

    def _place_all(self) -> bool:
        """Give each object its turns; return whether the robot was not stopped."""
        order, progress = self._order, self._progress
        effort, n_deferred = Effort.PLAIN, 0  # with this effort, in a row
        while order:
            placement = order.next()
            try:
                outcome = self._attempt(placement, effort)
            except RobotStoppedError as error:
                for given_up in progress.give_up([goal.name for goal in (placement, *order)], str(error)):
                    self._notify("failed", given_up.name, given_up.reason)
                return False
            if outcome is None:
                if effort == Effort.PLAIN and self._make_way(placement):
                    n_deferred = 0
                    continue
                order.put_last(placement)
                n_deferred += 1
                if n_deferred >= len(order):
                    effort, n_deferred = Effort(effort + 1), 0
                continue
            if outcome.attempts or outcome.name in self.scene.forgotten:
                effort, n_deferred = Effort.PLAIN, 0
            if self.can_see and progress.gets_another_chance(outcome):
                self._notify("deferred", placement.name, outcome.reason)
                order.put_last(placement)
                continue
            progress.record(outcome)
            self._notify("placed" if outcome.placed else "failed", placement.name, outcome.reason)
            order.put_unblocked_first(outcome.name)
        return True

    def _attempt(self, placement: Placement, effort: Effort) -> ObjectOutcome | None:
        """Try to place one object; return None if it is deferred."""
        if self._progress.waits_for_stack(placement) and effort < Effort.CLEARING:
            self._order.note_blockers(placement.name, placement.stack)
            return None
        outcome = self._place(self._progress.with_placed_stack(placement, self.scene.poses()), effort)
        is_unplanned = outcome.attempts == 0 and placement.name not in self.scene.forgotten
        most = Effort.BESIDE if placement.stack else Effort.CLEARING
        if is_unplanned and effort < most:
            self._notify("deferred", placement.name, outcome.reason)
            return None
        return outcome

    def _make_way(self, placement: Placement) -> bool:
        """Put first or set aside what is most in an object's way, if that helps; return whether it was."""
        order, blocker = self._order, self._order.first_blocker(placement.name)
        if blocker is None:
            return False
        remedy = order.remedy(placement, blocker, self._progress.waits_for_stack(blocker))
        if remedy == "placed first":
            order.put_before(blocker, placement)
            return True
        if remedy == "set aside" and self._clear(placement.name, [blocker.name]):
            order.put_first(placement)
            return True
        return False

    def _place(self, placement: Placement, effort: Effort) -> ObjectOutcome:
        """Try to place one object; the outcome has 0 attempts if there is no plan for the first."""
        name, before = placement.name, self._progress.before(placement.name)
        number, n_before = self.task.objects[name].id, before.attempts if before else 0
        tried: list[Grasp] = []
        reason, attempts = "", 0
        is_located = name in self._located
        self._located.discard(name)
        if (before is not None and not is_located) or name in self.scene.forgotten:
            reason = self._follower.search(name).problem
            if reason:
                return self._progress.failed_attempt(name, 0, reason)
        is_confirmed = False  # whether an object that one image did not show was found where it was expected
        for _ in range(2 * (1 + self.config.max_retries)):
            is_known, is_missed, is_unknown = False, False, False
            if attempts > self.config.max_retries:
                break
            self._notify("plan", name)
            self.withdrawal.leave()
            is_turned = lies(self.scene.pose(name))
            try:
                plan = self._plan(placement, tried, effort)
            except PlanningError as error:
                reason = f"{reason}; then {error}" if reason else str(error)
                self._order.note_blockers(name, error.blockers if isinstance(error, NoPlanError) else ())
                logger.info("%s", error)
                return self._progress.failed_attempt(name, attempts, reason)
            self._ahead.begin(plan, self._following(plan, placement, is_turned))
            try:
                self.motion.run(plan, looks_first=not is_confirmed)
                self._look_beside(plan)
                if plan.placement is placement or not is_turned:
                    self._note_contents(plan)
                    T = self.scene.pose(name)
                    return ObjectOutcome(number, name, True, n_before + attempts + 1, "", T)
                continue  # turned, to be grasped again
            except SceneChangedError as error:
                reason, is_missed = str(error), True
            except (GraspFailedError, RobotError) as error:
                reason, is_known = str(error), isinstance(error, LeaningError)
                if is_known:  # the box becomes fuller
                    effort = Effort.BESIDE
                attempts += 1
                tried.append(plan.grasp)
                self._blocked[name] += isinstance(error, GoalBlockedError)
                is_unknown = isinstance(error, UnknownInTheWayError | ApproachBlockedError)
                self.motion.recovery.back_off(plan.grasp)
                self._look_beside(plan)
            logger.info("%s, attempt %d: %s", name, attempts, reason)
            self._notify("retry", name, reason)
            found = Searched() if is_known else self._follower.search(name)
            for inside in plan.contents:
                self._follower.search(inside)
            if found.problem:
                return self._progress.failed_attempt(name, attempts, f"{reason}; {found.problem}")
            if is_unknown and not self._may_go_round(name):
                break
            is_confirmed = is_missed and found.is_in_place
        return self._progress.failed_attempt(name, attempts, reason)

    def _may_go_round(self, name: str) -> bool:
        """Look for what was in the hand's way to an object; return whether the hand may try other ways.

        What is met again and again is the object itself, or a neighbour that is not as it was taken to be:
        each touch may move it.
        """
        self._unknown[name] += 1
        if self._unknown[name] >= _MAX_UNKNOWN:
            return False
        self._follower.renew_obstacles()
        return True

    def _following(self, plan: PickPlacePlan, placement: Placement, is_turned: bool) -> Placement | None:
        """Return the goal that is planned next if a plan is executed as expected; None if it has to wait."""
        if is_turned and plan.placement is not placement:
            return placement  # grasped again
        name, progress = plan.name, self._progress
        following = self._order.following(name, but=plan.contents)
        if following is None or progress.waits_for_stack(following, besides=name):
            return None
        poses = self.scene.poses()
        return progress.with_placed_stack(following, {**poses, **plan.poses_after(poses)}, besides=name)

    def _note_contents(self, plan: PickPlacePlan) -> None:
        """Record that the bowls in a placed one were placed with it."""
        for name in plan.contents:
            T = self.scene.pose(name)
            self._progress.record(ObjectOutcome(self.task.objects[name].id, name, True, 1, "", T))
            self._order.drop(name)
            self._notify("placed", name, f"in {plan.name}")

    def _look_beside(self, plan: PickPlacePlan) -> None:
        """Follow what an object has pushed or knocked over; what was placed is placed again if need be."""
        T = self.scene.poses().get(plan.name, plan.T_world_stand_rest)
        for name, T_before in self._follower.displaced_near(
            T, but={plan.name, *plan.contents, *plan.placement.stack}
        ):
            if not self._progress.is_placed(name) or self._is_in_place(name, T_before):
                continue  # searched for in its turn, or judged by the final verification
            reason = f"{name} was moved by {plan.name}"
            outcome = self._progress.outcomes[name]
            moved = replace(outcome, placed=False, reason=reason, T_world_stand=None)
            if self.can_see and self._progress.gets_another_chance(moved):
                self._notify("deferred", name, reason)
                self._progress.reopen(name)
                self._located.add(name)
                self._order.put_first(self._progress.goals[name])  # what comes later may block its way
            else:
                self._notify("failed", name, reason)
                self._progress.record(moved)

    def _is_in_place(self, name: str, T_before: Float[np.ndarray, "4 4"]) -> bool:
        """Return whether a placed object that was moved still stands in the box; without one, at its goal."""
        T, box = self.scene.pose(name), self.task.box
        if box is None:
            return not is_displaced(T_before, T, self.motion.misplaced)
        return not lies(T) and box.contains(T)

    def _plan(self, placement: Placement, tried: Sequence[Grasp], effort: Effort) -> PickPlacePlan:
        """Return the next plan for an object: the one that was made ahead, or one for what is there now.

        A hand that no path leads away from is moved above the objects first. What blocks the object is set
        aside before, or the object is pushed, if that helps.

        Raises:
            PlanningError: there is none.
        """
        worth: set[str] | None = None  # moving what is in its place already
        blocked = self._blocked[placement.name]
        while True:
            q = self.robot.joint_positions()
            try:
                may_be_ahead = effort == Effort.PLAIN and not tried and not blocked
                ahead = self._ahead.take(placement, q) if may_be_ahead else None
                return ahead or self.planning.next_plan(placement, q, tried, effort, blocked)
            except NoPlanError as error:
                if error.is_enclosed and self.withdrawal.has_risen():
                    continue
                names = [
                    *(blocker for blocker in error.blockers if blocker != placement.name),
                    placement.name,
                ]
                if effort < Effort.CLEARING:
                    raise
                if worth is None:
                    worth = self._worth_moving(placement, tried, effort, error.blockers)
                if not self._clear(placement.name, names, worth) and not self._push(placement.name):
                    raise
                if placement.name in self.scene.forgotten:  # lost on the way
                    raise

    def _worth_moving(
        self, placement: Placement, tried: Sequence[Grasp], effort: Effort, blockers: Sequence[str]
    ) -> set[str]:
        """Return which of the objects that are in their places are to be moved for one that has no plan.

        It is empty if the object had no plan without them either, or if one of them could not be put back:
        each that is moved may be lost.
        """
        settled = self._settled()
        if settled.isdisjoint(blockers):
            return set()
        q, poses = self.robot.joint_positions(), self.scene.poses()
        goals = self._progress.goals | self.planning.places.in_place(self._progress.goals)
        places = {name: self._progress.with_placed_stack(goals[name], poses) for name in settled}
        movable = self._movable()
        return settled & self.planning.in_the_way(placement, q, tried, effort, movable, places)

    def _movable(self) -> set[str]:
        """Return the names of the objects that can be set aside and put back; bowls below others cannot."""
        kept = self.planning.places.in_place(self._progress.goals).keys()
        return (self._beside_box() | kept) - self._progress.below_others()

    def _settled(self) -> set[str]:
        """Return the names of the objects that were placed, or stood in the box or on a row before."""
        return self._progress.placed() | self.planning.places.in_place(self._progress.goals).keys()

    def _clear(self, name: str, names: Sequence[str], worth: Collection[str] = ()) -> bool:
        """Set one of several objects aside for another one, or that one itself; return whether one was moved.

        The object itself comes last: between its neighbours it may only be held with a hand that does not fit
        its goal, and on free table from all sides. What stood in its place before is placed again afterwards.

        Args:
            name: the object that has no plan.
            names: objects that may be set aside, in descending order of preference.
            worth: those of the objects in their places that may be moved.
        """
        goals = self._progress.goals
        before = self.planning.places.in_place(goals)
        kept = self._settled() - set(worth)
        plan = self._clearing.plan_aside(names, self._movable() - kept)
        if plan is None:
            return False
        reason = "its neighbours block its way" if plan.name == name else f"it blocks {name}"
        self._notify("aside", plan.name, reason)
        if plan.name in before:
            goals[plan.name] = before[plan.name]
            self._order.put_last(goals[plan.name])
        elif self._progress.reopen(plan.name):
            self._order.put_last(goals[plan.name])
        self._clearing.set_aside(plan)
        return True

    def _push(self, name: str) -> bool:
        """Push an object to where it can be grasped; return whether it was, and is in view."""
        push = self._clearing.plan_push(name) if self.can_see else None
        if push is None:
            return False
        self._notify("push", name, "no hand fits beside it")
        self._clearing.push(push)
        return name not in self.scene.forgotten

    def _beside_box(self) -> set[str]:
        """Return the names of the objects with a goal, and of those that are not in the box."""
        poses, box = self.scene.poses(), self.task.box
        in_box = {name for name, T in poses.items() if box is not None and box.contains(T)}
        return set(poses) - (in_box - self._progress.goals.keys())

    def _notify(self, phase: Phase, name: str, message: str = "", plan: PickPlacePlan | None = None) -> None:
        done, total = len(self._progress.outcomes), len(self._progress.goals)
        candidates = tuple(self.scene.grasps(name).grasps) if plan else ()
        self.on_event(TaskEvent(phase, name, done, total, message, plan, candidates))
