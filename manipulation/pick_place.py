"""Pick-and-place motions for one object.

Pairs of a grasp and a yaw at the goal are examined, best grasp first. A pair is feasible if approach, lift,
transfer with the carried object, release and retreat are all within reach and free of collisions.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from manipulation.candidates import NO_WAY, Tally, are_similar, ordered_yaws
from manipulation.collision import Body, CollisionConfig, CollisionWorld
from manipulation.errors import NoPlanError
from manipulation.grasp_config import GraspConfig
from manipulation.hulls import convex_pieces
from manipulation.kinematics import IkConfig, Kinematics
from manipulation.known_grasps import KnownGrasps
from manipulation.lying_grasps import lies
from manipulation.motions import MIDDLE_RADIUS, MotionPlanner
from manipulation.nesting import nest_heights
from manipulation.obstacles import TABLE, Obstacle
from manipulation.pick_place_segments import Pick, Place, PlaceGoal, SegmentConfig, find_pick, find_place
from manipulation.plan_timing import PlanTiming
from manipulation.reach import reaches_any
from manipulation.reorientation import rolled
from manipulation.surroundings import Surfaces, points_around
from manipulation.trajectories import MotionConfig
from manipulation.types import Grasp, GraspSet, PickPlacePlan, Placement, Rejected, StandingObject
from manipulation.vessels import holds, vessel_pieces
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle

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
    """Plans one object after the other in a collision world that follows moved and re-observed objects.

    Args:
        kinematics: kinematics of the arm.
        items: all objects by name.
        obstacles: static obstacles, of known geometry or perceived.
        config: settings of the search.
        grasps: known grasp candidates by name; those that are missing are generated.
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
        self.items = dict(items)
        self._obstacles = tuple(obstacles)
        self._known = KnownGrasps(self.items, config.grasp, self._points_around, grasps)
        self._surfaces = Surfaces()
        self._lifts: dict[tuple[str, ...], float] = {}  # of the last bowls of stacks
        self._forgotten: set[str] = set()
        self._states, self._state = itertools.count(1), 0
        self._examined: dict[Hashable, tuple[Grasp, Pick | Rejected]] = {}  # picks in this scene
        self._build_world({name: item.T_world_stand for name, item in self.items.items()})

    def _build_world(self, poses: Mapping[str, Float[np.ndarray, "4 4"]]) -> None:
        """Build the collision world with the objects at ``poses``, their T_world_stand."""
        bodies = [Body(name, self._pieces(name, poses), T) for name, T in poses.items()]
        self.world = CollisionWorld(self.kinematics.arm, bodies, self._obstacles, self.config.collision)
        c = self.config
        self.motions = MotionPlanner(self.kinematics, self.world, c.motion, c.via_heights, c.middle_radius)
        self._timing = PlanTiming(self.motions)

    def _pieces(
        self, name: str, poses: Mapping[str, Float[np.ndarray, "4 4"]]
    ) -> tuple[Float[np.ndarray, "_k 3"], ...]:
        """Return the convex pieces of an object: of a vessel that holds another one, with its cavity free."""
        item = self.items[name]
        others = [(self.items[n], T) for n, T in poses.items() if n != name and n not in self._forgotten]
        if holds(item, poses[name], others):
            return vessel_pieces(item, self.config.grasp)
        return convex_pieces(item)

    @property
    def forgotten(self) -> frozenset[str]:
        """Names of the objects of unknown pose."""
        return frozenset(self._forgotten)

    @property
    def obstacles(self) -> tuple[Obstacle | PerceivedObstacle, ...]:
        """The static obstacles, of known geometry or perceived."""
        return self._obstacles

    @property
    def perceived_obstacles(self) -> tuple[PerceivedObstacle, ...]:
        """The obstacles of perceived geometry."""
        return tuple(o for o in self._obstacles if isinstance(o, PerceivedObstacle))

    @property
    def scene_state(self) -> int:
        """Number of the state of the scene: what failed in it fails again."""
        return self._state

    def _on_change(self) -> None:
        self._state, self._examined = next(self._states), {}
        self._known.on_change()

    def poses(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Return T_world_stand of every object that is not forgotten, by name."""
        return {name: self.world.pose(name) for name in self.world.names if name not in self._forgotten}

    def observe_obstacles(self, obstacles: Sequence[PerceivedObstacle]) -> None:
        """Replace the perceived obstacles; objects remain as they are, forgotten ones forgotten."""
        known = tuple(o for o in self._obstacles if not isinstance(o, PerceivedObstacle))
        poses = {name: self.world.pose(name) for name in self.world.names}
        self._obstacles = (*known, *obstacles)
        self._build_world(poses)
        self._on_change()
        for name in poses:
            self.world.set_present(name, name not in self._forgotten)

    def moved(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> None:
        """Set the pose of an object that was moved, in any orientation."""
        self.world.set_present(name, True)
        self.world.move(name, T_world_stand)
        self._known.on_move(name)
        self._on_change()
        self._forgotten.discard(name)

    def forget(self, name: str) -> None:
        """Remove an object of unknown pose from the collision world."""
        self.world.set_present(name, False)
        self._on_change()
        self._forgotten.add(name)

    @contextlib.contextmanager
    def without(self, names: Collection[str]) -> Iterator[None]:
        """Plan as if some objects were not there; the scene is the same again afterwards."""
        absent = set(names) - self._forgotten
        if not absent:
            yield
            return
        with self._other_scene():
            self._forgotten |= absent
            for name in absent:
                self.world.set_present(name, False)
            try:
                yield
            finally:
                self._forgotten -= absent
                for name in absent:
                    self.world.set_present(name, True)

    @contextlib.contextmanager
    def supposing(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> Iterator[None]:
        """Plan as if an object of known pose were at another one; the scene is the same again afterwards."""
        T_now = self.world.pose(name)
        with self._other_scene():
            self.world.move(name, T_world_stand)
            self._known.on_move(name)
            try:
                yield
            finally:
                self.world.move(name, T_now)
                self._known.on_move(name)

    @contextlib.contextmanager
    def _other_scene(self) -> Iterator[None]:
        """Let nothing that is found in another scene be used in this one, nor the other way round."""
        state, examined = self._state, self._examined
        self._on_change()
        try:
            yield
        finally:
            self._known.on_change()
            self._state, self._examined = state, examined

    def grasps(self, name: str) -> GraspSet:
        """Return the grasp candidates of an object at its present pose, see ``KnownGrasps``."""
        return self._known.at(name, self.world.pose(name))

    def tilted_grasps(self, name: str) -> GraspSet:
        """Return grasps at any angle of the hand, clear of surroundings, see ``KnownGrasps``."""
        return self._known.tilted(name, self.world.pose(name))

    def keeping_grasps(self, name: str) -> GraspSet:
        """Return such grasps with which an object keeps its orientation, see ``KnownGrasps``."""
        return self._known.keeping(name, self.world.pose(name))

    def _points_around(self, name: str) -> Float[np.ndarray, "n 3"]:
        """Return points of what is around an object, in its stand frame [m]."""
        T = self.world.pose(name)
        others = [(self.items[other], pose) for other, pose in self.poses().items() if other != name]
        return points_around(T[:3, 3], others, self.perceived_obstacles, self._surfaces) @ T[:3, :3]

    def resting_pose(self, placement: Placement, yaw: float) -> Float[np.ndarray, "4 4"]:
        """Return ``T_world_stand`` at rest, on the floor or in the bowls of its stack, at a yaw [rad]."""
        if placement.T_goal_stand is not None:
            return pose_from_yaw(yaw, np.array(placement.position)) @ placement.T_goal_stand
        names = (*placement.stack, placement.name)
        if names not in self._lifts:
            self._lifts[names] = nest_heights([self.items[name] for name in names])[-1]
        return pose_from_yaw(yaw, np.add(placement.position, (0.0, 0.0, self._lifts[names])))

    def reaches(self, placement: Placement) -> bool:
        """Return whether the arm reaches an object at its goal, whatever the hand meets there."""
        T = self.resting_pose(placement, placement.yaws[0])
        return reaches_any(self.kinematics, placement.name, T, self._known.at(placement.name, T))

    def bowls_in(self, name: str) -> tuple[str, ...]:
        """Return the names of the upright bowls in the cavity of a bowl; none if it holds anything else."""
        item, poses = self.items[name], self.poses()
        inside = [n for n, T in poses.items() if n != name and holds(item, poses[name], [(self.items[n], T)])]
        are_bowls = all(self.items[n].category == "bowl" and not lies(poses[n]) for n in (name, *inside))
        return tuple(inside) if are_bowls else ()

    def can_place_after(self, placement: Placement, before: Sequence[Placement]) -> bool:
        """Return whether an object has a free release at its goal once others are at their own.

        How the object is picked up, and the way there, are not examined. Of a forgotten one nothing is: True.

        Args:
            placement: goal of the object.
            before: goals of the others.
        """
        if placement.name in self._forgotten:
            return True
        Ts_now = {goal.name: self.world.pose(goal.name) for goal in before}
        for goal in before:
            self.world.move(goal.name, self.resting_pose(goal, goal.yaws[0]))
        home = np.asarray(self.kinematics.arm.q_home, dtype=np.float64)[None]
        T_object, T_goal = self.world.pose(placement.name), self.resting_pose(placement, 0.0)
        grasps = self.grasps(placement.name).grasps
        try:
            for grasp in grasps[:: max(1, len(grasps) // _SAMPLES)]:
                for yaw in ordered_yaws(T_object, T_goal, grasp.T_stand_tcp, placement)[:_SAMPLED_YAWS]:
                    goal = PlaceGoal(self.items[placement.name], placement, self.resting_pose(placement, yaw))
                    pick = Pick(grasp, home, home)
                    if not isinstance(find_place(self.motions, pick, goal, self.config.segments), Rejected):
                        return True
            return False
        finally:
            self.world.release()
            for name, T_now in Ts_now.items():
                self.world.move(name, T_now)

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
            grasps: candidates other than those of ``grasps``.
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
        candidates = grasps or self.grasps(name)
        with self.world.containing(name, contents):
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

    def can_pick(
        self, name: str, T_world_stand: Float[np.ndarray, "4 4"], grasps: GraspSet | None = None
    ) -> bool:
        """Return whether an object could be grasped and lifted at another pose.

        Args:
            name: name of the object.
            T_world_stand: the pose.
            grasps: candidates there; without them those at its present pose.
        """
        T_now, candidates = self.world.pose(name), self.grasps(name) if grasps is None else grasps
        examined, self._examined = self._examined, {}
        self.world.move(name, T_world_stand)
        try:
            return next(self._picks(name, candidates, (), Tally()), None) is not None
        finally:
            self.world.release()
            self.world.move(name, T_now)
            self._examined = examined

    def _picks(
        self,
        name: str,
        candidates: GraspSet,
        tried: Collection[Grasp],
        tally: Tally,
        contents: Sequence[str] = (),
    ) -> Iterator[Pick]:
        """Yield feasible picks, best grasp first; the world has the object in the hand then."""
        for grasp in candidates.grasps:
            if any(are_similar(grasp, other) for other in tried):
                continue
            key = (name, tuple(contents), id(grasp))
            known = self._examined.get(key)
            if known is None:
                pick = find_pick(self.motions, name, grasp, self.config.segments)
                self._examined[key] = grasp, pick  # kept, so that nothing else gets its id
            else:
                pick = known[1]
            if isinstance(pick, Rejected):
                tally.reject(pick)
                continue
            if known is not None:
                self.world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
            yield pick

    def _complete(
        self, pick: Pick, placement: Placement, q_start: np.ndarray, tally: Tally
    ) -> PickPlacePlan | None:
        """Return the plan with a pick and the first feasible yaw at the goal; None if there is none.

        A yaw to which the object is carried level is preferred.
        """
        name, grasp = placement.name, pick.grasp
        c = self.config
        if placement.T_goal_stand is not None:
            T_goal_stand = rolled(self.items[name], placement.T_goal_stand, grasp.away)
            placement = replace(placement, T_goal_stand=T_goal_stand)
        swinging: tuple[Place, PlaceGoal, list[Float[np.ndarray, "n"]]] | None = None
        T_now, T_goal = self.world.pose(name), self.resting_pose(placement, 0.0)
        for yaw in ordered_yaws(T_now, T_goal, grasp.T_stand_tcp, placement):
            T_rest = self.resting_pose(placement, yaw)
            goal = PlaceGoal(self.items[name], placement, T_rest)
            place = find_place(self.motions, pick, goal, self.config.segments)
            if isinstance(place, Rejected):
                tally.reject(place)
                continue
            self.world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
            ends, width, margins = (pick.lift[-1], place.lowering[0]), grasp.held_width, c.transit_margins
            carrying = self.motions.carrying_path(*ends, width, margins)
            if carrying is None:
                if swinging is None:
                    tally.reject(Rejected("without a collision-free path to the goal"))
                continue
            carry, is_level = carrying
            if is_level:
                return self._with_start(pick, place, goal, carry, q_start, tally)
            swinging = swinging or (place, goal, carry)
        return self._with_start(pick, *swinging, q_start, tally) if swinging else None

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
        self.world.release()
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
        carry, transfer = self._timing.transfer(goal.item, pick.grasp, way, place.lowering)
        return PickPlacePlan(
            name=goal.item.name,
            grasp=pick.grasp,
            placement=goal.placement,
            T_world_stand_goal=place.T_world_stand_goal,
            T_world_stand_rest=goal.T_world_stand_rest,
            release_opening=place.release_opening,
            transit=self._timing.transit(start, pick.grasp.opening) if moves else None,
            approach=self.motions.time_line(pick.approach),
            lift=self.motions.time_line(pick.lift, "carried"),
            transfer=transfer,
            carry=carry,
            settle=None if place.settle is None else self.motions.time_line(place.settle),
            retreat=self.motions.time_line(place.retreat),
        )
