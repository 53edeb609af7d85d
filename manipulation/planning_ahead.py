"""Planning of the next object while the arm moves the present one.

The next object is planned in the scene as it will be, and from where the arm will be, if all goes well. Where
something else happens, that plan is dropped, and the object is planned from what is there then. Which of the
two it is depends on the scene alone, not on which thread is faster: the same scene gives the same motions.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from types import TracebackType

import numpy as np
from jaxtyping import Float

from manipulation.kinematics import Kinematics
from manipulation.object_planning import ObjectPlanning, Posture
from manipulation.obstacles import Obstacle
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.planning_scene import PlanningScene
from manipulation.types import PickPlacePlan, Placement, TaskPlan
from perception.obstacles.obstacle import PerceivedObstacle

_AS_EXPECTED = 0.01  # [rad] of each joint; a robot begins motions from within 0.03


@dataclass(frozen=True)
class Snapshot:
    """What a plan depends on besides goal and posture: a scene at one moment.

    Attributes:
        poses: T_world_stand of every object by name, of a forgotten one the last known.
        forgotten: names of the objects of unknown pose.
        obstacles: everything else, of known geometry or perceived.
    """

    poses: Mapping[str, Float[np.ndarray, "4 4"]]
    forgotten: frozenset[str]
    obstacles: tuple[Obstacle | PerceivedObstacle, ...]

    @staticmethod
    def of(scene: PlanningScene) -> Snapshot:
        """Return the scene as it is now."""
        poses = {name: scene.pose(name) for name in scene.world.names}
        return Snapshot(poses, scene.forgotten, scene.obstacles)

    def after(self, plan: PickPlacePlan) -> Snapshot:
        """Return the scene once a plan has been executed."""
        return replace(self, poses={**self.poses, **plan.poses_after(self.poses)})

    def is_same(self, other: Snapshot) -> bool:
        """Return whether the same objects are at the same poses among the same obstacles."""
        return (
            self.forgotten == other.forgotten
            and len(self.obstacles) == len(other.obstacles)
            and all(a is b for a, b in zip(self.obstacles, other.obstacles, strict=True))
            and self.poses.keys() == other.poses.keys()
            and all(np.array_equal(T, other.poses[name]) for name, T in self.poses.items())
        )


@dataclass(frozen=True)
class _Begun:
    """A plan that is being made, and what it is made for."""

    placement: Placement
    scene: Snapshot
    q_start: Posture
    plan: Future[PickPlacePlan]


class PlanningAhead:
    """Plans one object in a thread of its own, with least effort and a planner of its own.

    Args:
        task: goals of all objects.
        planner: planner whose scene follows the objects; it is only read, in ``begin`` and ``take``.
        config: settings.
    """

    def __init__(self, task: TaskPlan, planner: PickPlacePlanner, config: ManipulationConfig) -> None:
        self._task, self._planner, self._config = task, planner, config
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="planning ahead")
        self._begun: _Begun | None = None

    def __enter__(self) -> PlanningAhead:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)

    def begin(self, present: PickPlacePlan, following: Placement | None) -> None:
        """Begin to plan the next object.

        Args:
            present: plan that is about to be executed.
            following: goal of the next object once it has been; None for no plan.
        """
        self._drop()
        if following is None:
            return
        scene, q_start = Snapshot.of(self._planner.scene).after(present), present.retreat.positions[-1]
        plan = self._thread.submit(self._plan, following, scene, q_start)
        self._begun = _Begun(following, scene, q_start, plan)

    def take(self, placement: Placement, q: Posture) -> PickPlacePlan | None:
        """Return the plan that was begun for an object, once it is there; None if it does not fit.

        Args:
            placement: goal of the object.
            q: (n,) present posture in [rad].

        Raises:
            PlanningError: it was begun for this goal, scene and posture, and there is none.
        """
        begun = self._begun
        if (
            begun is None
            or not _is_same_goal(begun.placement, placement)
            or not begun.scene.is_same(Snapshot.of(self._planner.scene))
            or np.abs(begun.q_start - q).max() > _AS_EXPECTED
        ):
            self._drop()
            return None
        self._begun = None
        return begun.plan.result()

    def _drop(self) -> None:
        """Forget the plan that was begun; one that is being made already is made in vain."""
        if self._begun is not None:
            self._begun.plan.cancel()
            self._begun = None

    def _plan(self, placement: Placement, scene: Snapshot, q_start: Posture) -> PickPlacePlan:
        """Return the plan for one object in a scene; runs in the thread."""
        items = {
            name: replace(item, T_world_stand=scene.poses[name]) for name, item in self._task.objects.items()
        }
        settings, grasps = self._config.pick_place, self._task.grasps
        planner = PickPlacePlanner(self._kinematics, items, scene.obstacles, settings, grasps)
        for name in scene.forgotten:
            planner.scene.forget(name)
        return ObjectPlanning(self._task, planner, self._config).next_plan(placement, q_start)

    @cached_property
    def _kinematics(self) -> Kinematics:
        """Kinematics of the thread; those of the planner belong to the execution."""
        return Kinematics(self._planner.kinematics.arm, self._planner.kinematics.config)


def _is_same_goal(first: Placement, second: Placement) -> bool:
    """Return whether two goals are the same; arrays must be the same object."""
    others = (replace(goal, T_goal_stand=None) for goal in (first, second))
    return first.T_goal_stand is second.T_goal_stand and next(others) == next(others)
