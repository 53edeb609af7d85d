"""Pick-and-place motions for one object.

Pairs of a grasp and a yaw at the goal are examined, best grasp first. A pair is feasible if approach, lift,
transfer with the carried object, release and retreat are all within reach and free of collisions.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from manipulation.candidates import NO_WAY, Tally, are_similar, ordered_yaws
from manipulation.collision import CollisionConfig
from manipulation.errors import NoPlanError
from manipulation.grasp_config import GraspConfig
from manipulation.kinematics import IkConfig, Kinematics
from manipulation.motions import MIDDLE_RADIUS, MotionPlanner
from manipulation.nesting import nest_heights
from manipulation.obstacles import TABLE, Obstacle
from manipulation.pick_place_segments import Pick, Place, PlaceGoal, SegmentConfig, find_pick, find_place
from manipulation.plan_timing import PlanTiming
from manipulation.planning_scene import PlanningScene, SceneState
from manipulation.reach import reaches_any
from manipulation.reorientation import rolled
from manipulation.trajectories import MotionConfig
from manipulation.types import Grasp, GraspSet, PickPlacePlan, Placement, Rejected, StandingObject
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle

_Examined = dict[Hashable, tuple[Grasp, Pick | Rejected]]  # picks of grasps in one state of the scene

_SAMPLES, _SAMPLED_YAWS = 12, 3  # grasps of an object and yaws of its goal that are looked at in advance


@dataclass(frozen=True)
class PickPlaceConfig:
    """Settings of the search for a pick-and-place plan.

    Attributes:
        ik, motion, collision, grasp, segments: settings of the parts.
        via_heights: TCP heights of the waypoints of a blocked transit, in [m].
        middle_radius: distance from the base of a waypoint between start and goal in [m].
        transit_margins: clearances in transit in [m], in descending order; a smaller one is used only if no
            path keeps a larger one. Large, because shapes are estimates and a bowl may sag in the fingers.
        max_pairs, max_tilted_pairs: numbers of discarded candidates after which the search ends.
        max_plans: number of complete plans that are compared; the shortest in time is returned.
        max_score_loss: by how much the score of a grasp may be below the best one's for that.
    """

    ik: IkConfig = field(default_factory=IkConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    collision: CollisionConfig = field(default_factory=CollisionConfig)
    grasp: GraspConfig = field(default_factory=GraspConfig)
    segments: SegmentConfig = field(default_factory=SegmentConfig)
    via_heights: tuple[float, ...] = (0.35, 0.45, 0.55)
    middle_radius: float = MIDDLE_RADIUS
    transit_margins: tuple[float, ...] = (0.03, 0.012, 0.004)
    max_pairs: int = 300
    max_tilted_pairs: int = 100
    max_plans: int = 5
    max_score_loss: float = 0.03


class PickPlacePlanner:
    """Plans one object after the other in a scene that follows moved and re-observed objects.

    Args:
        kinematics: kinematics of the arm.
        items: all objects by name.
        obstacles: static obstacles, of known geometry or perceived.
        config: settings of the search.
        grasps: known grasp candidates by name; those that are missing are generated.

    Attributes:
        kinematics, config: as given.
        scene: objects and obstacles where they are now.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        items: Mapping[str, StandingObject],
        obstacles: Sequence[Obstacle | PerceivedObstacle] = (TABLE,),
        config: PickPlaceConfig = PickPlaceConfig(),
        grasps: Mapping[str, GraspSet] | None = None,
    ) -> None:
        self.kinematics, self.config = kinematics, config
        self.scene = PlanningScene(kinematics.arm, items, obstacles, config.collision, config.grasp, grasps)
        self._motions = self._motions_in_world()
        self._lifts: dict[tuple[str, ...], float] = {}  # of the last bowls of stacks
        self._examined: WeakKeyDictionary[SceneState, _Examined] = WeakKeyDictionary()

    def _motions_in_world(self) -> MotionPlanner:
        c = self.config
        return MotionPlanner(self.kinematics, self.scene.world, c.motion, c.via_heights, c.middle_radius)

    @property
    def motions(self) -> MotionPlanner:
        """Planner of motions in the scene's present collision world."""
        if self._motions.world is not self.scene.world:
            self._motions = self._motions_in_world()
        return self._motions

    def resting_pose(self, placement: Placement, yaw: float) -> Float[np.ndarray, "4 4"]:
        """Return ``T_world_stand`` at rest, on the floor or in the bowls of its stack, at a yaw [rad]."""
        if placement.T_goal_stand is not None:
            return pose_from_yaw(yaw, np.array(placement.position)) @ placement.T_goal_stand
        names = (*placement.stack, placement.name)
        if names not in self._lifts:
            self._lifts[names] = nest_heights([self.scene.items[name] for name in names])[-1]
        return pose_from_yaw(yaw, np.add(placement.position, (0.0, 0.0, self._lifts[names])))

    def reaches(self, placement: Placement) -> bool:
        """Return whether the arm reaches an object at its goal, whatever the hand meets there."""
        T = self.resting_pose(placement, placement.yaws[0])
        return reaches_any(self.kinematics, placement.name, T, self.scene.grasps_at(placement.name, T))

    def can_place_after(self, placement: Placement, before: Sequence[Placement]) -> bool:
        """Return whether an object has a free release at its goal once others are at their own.

        How the object is picked up, and the way there, are not examined. Of a forgotten one nothing is: True.

        Args:
            placement: goal of the object.
            before: goals of the others.
        """
        if placement.name in self.scene.forgotten:
            return True
        Ts_now = {goal.name: self.scene.pose(goal.name) for goal in before}
        for goal in before:
            self.scene.world.move(goal.name, self.resting_pose(goal, goal.yaws[0]))
        home = np.asarray(self.kinematics.arm.q_home, dtype=np.float64)[None]
        T_object, T_goal = self.scene.pose(placement.name), self.resting_pose(placement, 0.0)
        grasps = self.scene.grasps(placement.name).grasps
        try:
            for grasp in grasps[:: max(1, len(grasps) // _SAMPLES)]:
                for yaw in ordered_yaws(T_object, T_goal, grasp.T_stand_tcp, placement)[:_SAMPLED_YAWS]:
                    goal = PlaceGoal(
                        self.scene.items[placement.name], placement, self.resting_pose(placement, yaw)
                    )
                    pick = Pick(grasp, home, home)
                    if not isinstance(find_place(self.motions, pick, goal, self.config.segments), Rejected):
                        return True
            return False
        finally:
            self.scene.world.release()
            for name, T_now in Ts_now.items():
                self.scene.world.move(name, T_now)

    def plan(
        self,
        placement: Placement | Sequence[Placement],
        q_start: Float[np.ndarray, "n"],
        tried: Collection[Grasp] = (),
        grasps: GraspSet | None = None,
        contents: Sequence[str] = (),
    ) -> PickPlacePlan:
        """Plan all motions for one object from the present posture.

        Args:
            placement: goal of the object, or several in descending order of preference.
            q_start: (n,) present joint positions in [rad].
            tried: grasps that failed; these and similar ones are excluded.
            grasps: candidates other than those of ``PlanningScene.grasps``.
            contents: names of objects in it that are carried with it.

        Raises:
            NoPlanError: no pair of grasp and yaw is feasible; the message counts the reasons.
        """
        tally = Tally()
        limit = self.config.max_pairs if grasps is None else self.config.max_tilted_pairs
        plans: list[PickPlacePlan] = []
        least_score = -np.inf
        goals = (placement,) if isinstance(placement, Placement) else tuple(placement)
        name = goals[0].name
        candidates = grasps or self.scene.grasps(name)
        with self.scene.world.containing(name, contents):
            for pick in self._picks(name, candidates, tried, tally, contents):
                if pick.grasp.score < least_score:
                    break
                completed = (self._complete(pick, goal, q_start, tally) for goal in goals)
                plan = next((plan for plan in completed if plan is not None), None)
                if plan is not None:
                    if not plans:
                        least_score = pick.grasp.score - self.config.max_score_loss
                    plans.append(replace(plan, contents=tuple(contents)) if contents else plan)
                if len(plans) >= self.config.max_plans or tally.n_rejected > limit:
                    break
        if not plans:
            raise NoPlanError(tally.failure_message(name, candidates), tally.in_the_way, tally.is_enclosed)
        return min(plans, key=lambda plan: plan.duration)

    def continued_as_held(
        self, plan: PickPlacePlan, T_stand_tcp: Float[np.ndarray, "4 4"], q: Float[np.ndarray, "n"]
    ) -> PickPlacePlan | None:
        """Return a plan with the rest of the way for an object that is held otherwise than it was planned.

        Args:
            plan: the plan, carried out up to the end of ``lift`` or of ``carry``.
            T_stand_tcp: (4, 4) TCP pose in the stand frame, as the object is held.
            q: (n,) present posture in [rad], from which the returned plan carries the object.

        Returns:
            The plan; None if no yaw at the goal is feasible.
        """
        grasp = plan.grasp.held_at(T_stand_tcp)
        pick = Pick(grasp, plan.approach.positions, q[None])
        T_now = self.kinematics.forward(q) @ np.linalg.inv(T_stand_tcp)
        with self.scene.world.containing(plan.name, plan.contents):
            way = self._way_to_goal(pick, plan.placement, T_now, Tally())
            if way is None:
                return None
            place, goal, path = way
            carry = PlanTiming(self.motions).carry(goal.item, grasp, path)
        return replace(
            plan,
            grasp=grasp,
            T_world_stand_goal=place.T_world_stand_goal,
            T_world_stand_rest=goal.T_world_stand_rest,
            release_opening=place.release_opening,
            carry=carry,
            lowering=self.motions.time_line(place.lowering, "carried"),
            settle=None if place.settle is None else self.motions.time_line(place.settle),
            retreat=self.motions.time_line(place.retreat),
        )

    def can_pick(
        self, name: str, T_world_stand: Float[np.ndarray, "4 4"], grasps: GraspSet | None = None
    ) -> bool:
        """Return whether an object could be grasped and lifted at another pose.

        Args:
            name: name of the object.
            T_world_stand: the pose.
            grasps: candidates there; without them those at its present pose.
        """
        scene = self.scene
        T_now, candidates = scene.pose(name), scene.grasps(name) if grasps is None else grasps
        scene.world.move(name, T_world_stand)
        try:
            return next(self._picks(name, candidates, (), Tally(), examined={}), None) is not None
        finally:
            scene.world.release()
            scene.world.move(name, T_now)

    def _picks(
        self,
        name: str,
        candidates: GraspSet,
        tried: Collection[Grasp],
        tally: Tally,
        contents: Sequence[str] = (),
        examined: _Examined | None = None,
    ) -> Iterator[Pick]:
        """Yield feasible picks, best grasp first; the world has the object in the hand then.

        ``examined`` are the picks that are known already; by default those of the present state of the scene.
        """
        if examined is None:
            examined = self._examined.setdefault(self.scene.state, {})
        for grasp in candidates.grasps:
            if any(are_similar(grasp, other) for other in tried):
                continue
            key = (name, tuple(contents), id(grasp))
            known = examined.get(key)
            if known is None:
                pick = find_pick(self.motions, name, grasp, self.config.segments)
                examined[key] = grasp, pick  # kept, so that nothing else gets its id
            else:
                pick = known[1]
            if isinstance(pick, Rejected):
                tally.reject(pick)
                continue
            if known is not None:
                self.scene.world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
            yield pick

    def _complete(
        self, pick: Pick, placement: Placement, q_start: np.ndarray, tally: Tally
    ) -> PickPlacePlan | None:
        """Return the plan with a pick and the first feasible yaw at the goal; None if there is none.

        A yaw to which the object is carried level is preferred.
        """
        if placement.T_goal_stand is not None:
            T_goal_stand = rolled(self.scene.items[placement.name], placement.T_goal_stand, pick.grasp.away)
            placement = replace(placement, T_goal_stand=T_goal_stand)
        way = self._way_to_goal(pick, placement, self.scene.pose(placement.name), tally)
        return None if way is None else self._with_start(pick, *way, q_start, tally)

    def _way_to_goal(
        self, pick: Pick, placement: Placement, T_now: Float[np.ndarray, "4 4"], tally: Tally
    ) -> tuple[Place, PlaceGoal, list[Float[np.ndarray, "n"]]] | None:
        """Return place, goal and path of the first feasible yaw from the end of a lift, if there is one.

        Args:
            pick: how the object is held, and where the arm is.
            placement: goal of the object.
            T_now: (4, 4) T_world_stand, from which the hand should turn little.
            tally: counts what is discarded.
        """
        name, grasp, margins = placement.name, pick.grasp, self.config.transit_margins
        swinging: tuple[Place, PlaceGoal, list[Float[np.ndarray, "n"]]] | None = None
        T_goal = self.resting_pose(placement, 0.0)
        for yaw in ordered_yaws(T_now, T_goal, grasp.T_stand_tcp, placement):
            T_rest = self.resting_pose(placement, yaw)
            goal = PlaceGoal(self.scene.items[name], placement, T_rest)
            place = find_place(self.motions, pick, goal, self.config.segments)
            if isinstance(place, Rejected):
                tally.reject(place)
                continue
            self.scene.world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
            ends = pick.lift[-1], place.lowering[0]
            carrying = self.motions.carrying_path(*ends, grasp.held_width, margins)
            if carrying is None:
                if swinging is None:
                    tally.reject(Rejected("without a collision-free path to the goal"))
                continue
            path, is_level = carrying
            if is_level:
                return place, goal, path
            swinging = swinging or (place, goal, path)
        return swinging

    def _with_start(
        self,
        pick: Pick,
        place: Place,
        goal: PlaceGoal,
        carry: list[Float[np.ndarray, "n"]],
        q_start: np.ndarray,
        tally: Tally,
    ) -> PickPlacePlan | None:
        """Return the plan with a path to the object; None if there is none."""
        self.scene.world.release()
        start = self.motions.free_path(
            q_start, pick.approach[0], pick.grasp.opening, self.config.transit_margins
        )
        if start is None:
            tally.reject(NO_WAY)
            return None
        return self._time(pick, place, goal, start, carry)

    def _time(
        self,
        pick: Pick,
        place: Place,
        goal: PlaceGoal,
        start: list[np.ndarray],
        way: list[np.ndarray],
    ) -> PickPlacePlan:
        """Return the plan with trajectories for all motions."""
        moves = np.abs(start[0] - start[-1]).max() > 1e-6
        timing = PlanTiming(self.motions)
        return PickPlacePlan(
            name=goal.item.name,
            grasp=pick.grasp,
            placement=goal.placement,
            T_world_stand_goal=place.T_world_stand_goal,
            T_world_stand_rest=goal.T_world_stand_rest,
            release_opening=place.release_opening,
            transit=timing.transit(start, pick.grasp.opening) if moves else None,
            approach=self.motions.time_line(pick.approach),
            lift=self.motions.time_line(pick.lift, "carried"),
            carry=timing.carry(goal.item, pick.grasp, way),
            lowering=self.motions.time_line(place.lowering, "carried"),
            settle=None if place.settle is None else self.motions.time_line(place.settle),
            retreat=self.motions.time_line(place.retreat),
        )
