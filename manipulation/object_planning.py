"""Which plan an object gets next: to its goal, turned, at another place, or with what blocks it set aside.

Planning makes the least effort first; more is made when no object has a plan with less.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from itertools import islice
from types import MappingProxyType
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from manipulation.errors import NoPlanError, PlanningError
from manipulation.free_table import goals_aside
from manipulation.lying_grasps import is_upside_down, lies
from manipulation.open_places import OpenPlaces
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.planning_scene import SceneState
from manipulation.pushing import Push, plan_push
from manipulation.reorientation import reorienting_grasps, turning_goals
from manipulation.types import Grasp, GraspSet, PickPlacePlan, Placement, TaskPlan

DOUBTFUL = -1.5  # score of grasps of what nearly fills the hand, below which those at any angle come first
_TURN_OVER = "turn it over by hand"
_SPOTS = 4  # on free table that are tried for one object
_EXAMINED, _EVERY_YAW = 12, 3  # goals, and which of their yaws, that are examined for the next grasp
_ASIDE = 4  # objects that are tried in order to make room for one, itself included
LOW = 0.10  # [m] height of objects that may be dropped: the hand meets the walls of the box beside lower ones
DROP = 0.015  # [m] by which they may fall

Posture = Float[np.ndarray, "n"]


class Effort(IntEnum):
    """Means of planning, each in addition to those before it."""

    PLAIN = 0  # to the goal, with the grasps of the object's shape
    FLEXIBLE = 1  # other places in the box; any angle of the hand; released from a little higher
    CLEARING = 2  # what blocks an object is set aside, or it is pushed to where it can be grasped
    BESIDE = 3  # a bowl is placed beside those that it was to be put in


class ObjectPlanning:
    """Plans the next motion of one object, with increasing effort.

    Args:
        task: goals of all objects.
        planner: planner whose scene follows the objects.
        config: settings.

    Attributes:
        places: finds places for objects.
    """

    def __init__(self, task: TaskPlan, planner: PickPlacePlanner, config: ManipulationConfig) -> None:
        self._task, self._planner, self._config = task, planner, config
        self.places = OpenPlaces(task, planner.scene, config)
        self._goals = {placement.name for placement in task.placements}
        # By what was asked for, in each state of the scene: planning without some objects returns to this.
        self._failures: WeakKeyDictionary[SceneState, dict[Hashable, NoPlanError]] = WeakKeyDictionary()
        self._turnable: WeakKeyDictionary[SceneState, dict[Hashable, list[Placement]]] = WeakKeyDictionary()

    @property
    def _failed(self) -> dict[Hashable, NoPlanError]:
        """What failed in the present state of the scene."""
        return self._failures.setdefault(self._planner.scene.state, {})

    def next_plan(
        self,
        placement: Placement,
        q: Posture,
        tried: Sequence[Grasp] = (),
        effort: Effort = Effort.PLAIN,
        blocked: int = 0,
    ) -> PickPlacePlan:
        """Return the plan that places an object, or that turns it if it does not stand.

        Args:
            placement: its goal.
            q: present posture in [rad].
            tried: grasps that failed.
            effort: means of planning.
            blocked: how often it met something on its way to the goal: other places come first then, for what
                is to stand in others from the second time on.

        Raises:
            PlanningError: there is none with this effort.
        """
        if lies(self._planner.scene.pose(placement.name)):
            return self._turn(placement, q, tried, effort, blocked)
        roomier, sure = self.places.roomier(placement), self._sure_grasps(placement.name)
        goals = [placement] if roomier is placement else [roomier, placement]
        if blocked > len(placement.stack[:1]):
            goals = [*self.places.elsewhere(placement), *goals]
        try:
            return self._plan(goals, q, tried, sure)
        except PlanningError as error:
            if effort == Effort.PLAIN:
                raise
            may_be_elsewhere = not placement.stack or effort == Effort.BESIDE
            elsewhere = self.places.elsewhere(placement) if may_be_elsewhere else []
            if elsewhere:
                with contextlib.suppress(PlanningError):
                    return self._plan(elsewhere, q, tried, sure)
            with contextlib.suppress(PlanningError):
                return self._plan([placement, *elsewhere], q, tried, is_tilted=True)
            dropped = self._from_higher([*goals, *elsewhere])
            if dropped:
                with contextlib.suppress(PlanningError):
                    return self._plan(dropped, q, tried, sure)
            with contextlib.suppress(PlanningError):
                return self._plan_with_contents([placement, *elsewhere], q, tried)
            if sure is not None:
                with contextlib.suppress(PlanningError):
                    return self._plan([*goals, *elsewhere], q, tried)
            raise error

    def _from_higher(self, goals: Sequence[Placement]) -> list[Placement]:
        """Return the goals of a low object on the floor of the box, dropped from a little above."""
        if self._task.task != "pack" or self._task.objects[goals[0].name].top > LOW:
            return []
        return [replace(g, release_height=g.release_height + DROP) for g in goals if not g.stack]

    def _sure_grasps(self, name: str) -> GraspSet | None:
        """Return the grasps of an object but those that its estimated width hardly allows; None if all."""
        known = self._planner.scene.grasps(name)
        sure = tuple(grasp for grasp in known.grasps if grasp.score > DOUBTFUL)
        return None if len(sure) == len(known.grasps) else replace(known, grasps=sure)

    def plans_aside(
        self, names: Sequence[str], movable: Collection[str], q: Posture
    ) -> Iterator[PickPlacePlan]:
        """Yield plans that set one object aside on free table, in the order given.

        Args:
            names: names of what is in the way of an object, and of the object itself.
            movable: names of the objects that may be set aside.
            q: present posture in [rad].
        """
        planner = self._planner
        for name in [name for name in names if name in movable][:_ASIDE]:
            item, T = self._task.objects[name], planner.scene.pose(name)
            if ("aside", name) in self._failed:
                continue  # what failed is not tried again in the same scene
            goals = list(goals_aside(item, T, self.places.taken(name), self._config.free_area))
            spots = self._best_to_turn(goals) if lies(T) else goals[:_SPOTS]
            if not spots:
                continue
            try:
                plan = planner.plan(spots, q, grasps=planner.scene.keeping_grasps(name))
            except NoPlanError as error:
                self._failed["aside", name] = error
            else:
                yield plan

    def in_the_way(
        self,
        placement: Placement,
        q: Posture,
        tried: Sequence[Grasp],
        effort: Effort,
        movable: Collection[str],
        settled: Mapping[str, Placement] = MappingProxyType({}),
    ) -> set[str]:
        """Return the objects without which an object that has no plan has one; none if nothing helps.

        First all that candidates meet are left out. Then each is put back if the plan that is found so stays
        feasible or, where several are left, if there is another plan. Nothing helps if one of them is in its
        place, and would have none beside the object.

        Args:
            placement: goal of the object.
            q: present posture in [rad].
            tried: grasps that failed.
            effort: means of planning.
            movable: names of the objects that may be moved.
            settled: goals of those that are in their places, by name.
        """
        planner, plan = self._planner, None
        absent: set[str] = set()
        while plan is None:
            with planner.scene.without(absent):
                try:
                    plan = self.next_plan(placement, q, tried, effort)
                except PlanningError as error:
                    blockers = set(error.blockers) if isinstance(error, NoPlanError) else set()
                    found = (blockers & set(movable)) - absent - {placement.name}
                    if not found:
                        return set()
                    absent |= found
        same = GraspSet((plan.grasp,), Counter())
        for name in sorted(absent):
            with planner.scene.without(absent - {name}), contextlib.suppress(NoPlanError):
                planner.plan(plan.placement, q, grasps=same, contents=plan.contents)
                absent.discard(name)
        for name in sorted(absent) if len(absent) > 1 else ():
            with planner.scene.without(absent - {name}), contextlib.suppress(PlanningError):
                plan = self.next_plan(placement, q, tried, effort)
                absent.discard(name)
        goals = [settled[name] for name in sorted(absent & settled.keys())]
        return absent if all(self._has_place_after(goal, plan, absent) for goal in goals) else set()

    def _has_place_after(self, goal: Placement, plan: PickPlacePlan, absent: Collection[str]) -> bool:
        """Return whether an object has a free place, at its goal or elsewhere, once a plan is carried out.

        Args:
            goal: its goal.
            plan: plan of another object.
            absent: what is not there then.
        """
        planner = self._planner
        with (
            planner.scene.without(set(absent) - {goal.name}),
            planner.scene.supposing(plan.name, plan.T_world_stand_rest),
        ):
            return any(planner.can_place_after(g, ()) for g in (goal, *self.places.elsewhere(goal)))

    def push(self, name: str, q: Posture) -> Push | None:
        """Return a push after which an object can be grasped; None if there is none, or it is in the box."""
        planner, box = self._planner, self._task.box
        if box is not None and box.contains(planner.scene.pose(name)):
            return None
        if ("push", name) in self._failed:
            return None
        push = plan_push(planner.motions, self._task.objects[name], q, lambda T: planner.can_pick(name, T))
        if push is None:
            self._failed["push", name] = NoPlanError(f"no push helps {name}")
        return push

    def _turn(
        self, placement: Placement, q: Posture, tried: Sequence[Grasp], effort: Effort, blocked: int
    ) -> PickPlacePlan:
        """Return the plan that turns an object: at its goal if it is on its side, else on free table.

        One that met something on the way to its goal is turned on free table rather than there.

        Raises:
            PlanningError: there is none.
        """
        name, planner, item = placement.name, self._planner, self._task.objects[placement.name]
        T_world_stand = planner.scene.pose(name)
        overturned = is_upside_down(T_world_stand)
        how = "stands upside down" if overturned else "lies on its side"
        at = f"{name} {how} at ({T_world_stand[0, 3]:.2f}, {T_world_stand[1, 3]:.2f}) m"
        grasps = planner.scene.grasps(name)
        if not grasps.grasps:
            raise PlanningError(f"{at}: {grasps.failure_message(name, _TURN_OVER if overturned else '')}")
        spots = list(turning_goals(item, T_world_stand, self.places.taken(name), self._config.free_area))
        goals = self._best_to_turn(spots) if overturned else [placement, *self._in_reach(spots)]
        if blocked and not overturned:
            goals = [*goals[1:], placement]
        if not goals:
            raise PlanningError(f"{at}: no free table to turn it")
        try:
            return self._plan(goals, q, tried)
        except NoPlanError as error:
            if effort > Effort.PLAIN:
                elsewhere = [] if overturned else self.places.elsewhere(placement)
                with contextlib.suppress(PlanningError):
                    return self._plan([*goals, *elsewhere], q, tried, is_tilted=True)
            raise NoPlanError(
                f"{at} and cannot be turned: {error}", error.blockers, error.is_enclosed
            ) from error

    def _best_to_turn(self, goals: Sequence[Placement]) -> list[Placement]:
        """Return the first goals of an object that does not stand from which it can be turned by 90 degrees.

        Their yaws are those at which it could be grasped then. Where there are none, the first goals.
        """
        planner, config = self._planner, self._config.pick_place.grasp
        known = self._turnable.setdefault(planner.scene.state, {})
        key = tuple((goal.name, goal.position) for goal in goals)
        if key in known:
            return known[key]
        found: list[Placement] = []
        on_side: dict[int, GraspSet] = {}  # by the goal's orientation, which many have in common
        for goal in goals[:_EXAMINED]:
            assert goal.T_goal_stand is not None
            grasps = on_side.get(id(goal.T_goal_stand))
            if grasps is None:
                grasps = reorienting_grasps(planner.scene.items[goal.name], goal.T_goal_stand, config)
                on_side[id(goal.T_goal_stand)] = grasps
            poses = {yaw: planner.resting_pose(goal, yaw) for yaw in goal.yaws[::_EVERY_YAW]}
            yaws = tuple(yaw for yaw, T in poses.items() if planner.can_pick(goal.name, T, grasps))
            if yaws:
                found.append(replace(goal, yaws=yaws))
            if len(found) == _SPOTS:
                break
        known[key] = found or list(goals[:_SPOTS])
        return known[key]

    def _in_reach(self, goals: Sequence[Placement]) -> list[Placement]:
        """Return the first goals on free table from which an object that is set upright can be taken on.

        Where there are none, the first goals.
        """
        reached = filter(self._planner.reaches, goals[:_EXAMINED])
        return list(islice(reached, _SPOTS)) or list(goals[:_SPOTS])

    def _plan_with_contents(
        self, goals: Sequence[Placement], q: Posture, tried: Sequence[Grasp]
    ) -> PickPlacePlan:
        """Return the plan that carries a bowl with the bowls in it that wait for their turn.

        Raises:
            PlanningError: there is none, or the bowl is empty.
        """
        name = goals[0].name
        contents = self._planner.scene.bowls_in(name)
        if self._task.task != "pack" or not contents or not set(contents) <= self._goals:
            raise PlanningError(f"{name} holds no bowls that are to be packed")
        return self._plan(goals, q, tried, is_tilted=True, contents=contents)

    def _plan(
        self,
        goals: Sequence[Placement],
        q: Posture,
        tried: Sequence[Grasp],
        grasps: GraspSet | None = None,
        is_tilted: bool = False,
        contents: Sequence[str] = (),
    ) -> PickPlacePlan:
        """Return the plan to the first feasible goal; what failed is not tried again in the same scene.

        Raises:
            NoPlanError: there is none.
        """
        planner = self._planner
        key = (
            is_tilted,
            grasps is None,
            len(tried),
            tuple(contents),
            *((goal.name, goal.position, goal.stack, goal.release_height) for goal in goals),
        )
        failure = self._failed.get(key)
        if failure is not None:
            raise failure
        try:
            grasps = planner.scene.tilted_grasps(goals[0].name) if is_tilted else grasps
            return planner.plan(goals, q, tried, grasps, contents)
        except NoPlanError as error:
            if not error.is_enclosed:  # which depends on the posture too
                self._failed[key] = error
            raise
