"""Motions that take one object from where it stands to where it shall stand.

Grasps and placements are tried in pairs, best first. A pair is taken when the arm reaches every pose on the
way and nothing is touched: approach, lift and transfer with the object in hand, release, retreat.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from manipulation.collision import Body, CollisionConfig, CollisionWorld
from manipulation.errors import PlanningError
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import GraspSet, grasp_candidates
from manipulation.hulls import convex_pieces
from manipulation.kinematics import IkConfig, Kinematics
from manipulation.motions import Motions
from manipulation.nesting import nest_heights
from manipulation.obstacles import TABLE, Furniture, box_walls
from manipulation.pick_place_segments import HandlingConfig, Pick, Place, find_pick, find_place
from manipulation.robot import ArmDescription
from manipulation.trajectories import MotionConfig, concatenate
from manipulation.types import Box, Grasp, PickPlacePlan, Placement, StandingObject
from perception.geometry import pose_from_yaw

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PickPlaceConfig:
    """Heights, margins and effort of the search.

    Attributes:
        ik, motion, collision, grasp, handling: of the parts.
        via_heights: TCP heights of the points a blocked transit is led over, in [m].
        transit_margins: kept from everything on the way from start to goal, in [m]; less is only tried where
            no way allows more. Wide, because shapes are estimates and a bowl may sag in the fingers.
        max_pairs: pairs of grasp and yaw to examine at the goal before giving up.
        max_plans: complete plans to compare; the quickest is taken.
    """

    ik: IkConfig = field(default_factory=IkConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    collision: CollisionConfig = field(default_factory=CollisionConfig)
    grasp: GraspConfig = field(default_factory=GraspConfig)
    handling: HandlingConfig = field(default_factory=HandlingConfig)
    via_heights: tuple[float, ...] = (0.35, 0.45, 0.55)
    transit_margins: tuple[float, ...] = (0.03, 0.012, 0.004)
    max_pairs: int = 150
    max_plans: int = 2


@dataclass
class _Tally:
    """What was tried and why it failed, for the message when nothing works."""

    tried: int = 0
    reasons: Counter[str] = field(default_factory=Counter)

    def fail(self, reason: str) -> None:
        self.tried += 1
        self.reasons[reason] += 1

    def text(self, limit: int = 5) -> str:
        return ", ".join(f"{count} {reason}" for reason, count in self.reasons.most_common(limit))


class PickPlacePlanner:
    """Plans one object after the other in a world that changes as objects are moved and seen anew."""

    def __init__(
        self,
        arm: ArmDescription,
        items: Mapping[str, StandingObject],
        box: Box | None = None,
        config: PickPlaceConfig | None = None,
        furniture: Sequence[Furniture] = (TABLE,),
    ) -> None:
        self.config = config or PickPlaceConfig()
        self.arm = arm
        self.items = dict(items)
        self.kinematics = Kinematics(arm, self.config.ik)
        self._furniture = (*furniture, *(box_walls(box) if box is not None else ()))
        self._grasps: dict[str, GraspSet] = {}
        self._build_world()

    def _build_world(self) -> None:
        bodies = [Body(item.name, convex_pieces(item), item.T_world_stand) for item in self.items.values()]
        self.world = CollisionWorld(self.arm, bodies, self._furniture, self.config.collision)
        self.motions = Motions(self.kinematics, self.world, self.config.motion, self.config.via_heights)

    def observe(self, item: StandingObject) -> None:
        """Take over a new estimate of an object."""
        poses = {name: self.world.pose(name) for name in self.world.names if name != item.name}
        self.items[item.name] = item
        self._grasps.pop(item.name, None)
        self._build_world()
        for name, T in poses.items():
            self.world.move(name, T)

    def moved(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> None:
        """Note that an object now stands elsewhere."""
        self.world.move(name, T_world_stand)

    def forget(self, name: str) -> None:
        """Take an object that is nowhere to be seen out of the collision world."""
        self.world.set_present(name, False)

    def grasps(self, name: str) -> GraspSet:
        """Grasp candidates of an object, computed once per estimate."""
        if name not in self._grasps:
            self._grasps[name] = grasp_candidates(self.items[name], self.config.grasp)
        return self._grasps[name]

    def resting_pose(self, placement: Placement, yaw: float) -> Float[np.ndarray, "4 4"]:
        """``T_world_stand`` at rest: on the floor, or on the bowls of its stack."""
        stack = [self.items[name] for name in (*placement.stack, placement.name)]
        lift = nest_heights(stack)[-1] if len(stack) > 1 else 0.0
        return pose_from_yaw(yaw, np.add(placement.position, (0.0, 0.0, lift)))

    def plan(
        self,
        placement: Placement,
        q_start: Float[np.ndarray, "n"],
        tried: Collection[Grasp] = (),
    ) -> PickPlacePlan:
        """Motions for one object from the present posture.

        Args:
            placement: where it shall stand.
            q_start: (n,) present joint positions in [rad].
            tried: grasps that failed; they and those close to them are left out.

        Raises:
            PlanningError: no pair of grasp and placement works; the message counts why.
        """
        tally = _Tally()
        plans: list[PickPlacePlan] = []
        try:
            for pick in self._picks(placement.name, tried, tally):
                plan = self._complete(pick, placement, q_start, tally)
                if plan is not None:
                    plans.append(plan)
                if len(plans) >= self.config.max_plans or tally.tried > self.config.max_pairs:
                    break
        finally:
            self.world.release()
        if not plans:
            raise PlanningError(self._no_plan(placement.name, tally))
        return min(plans, key=lambda plan: plan.duration)

    def reachable_grasp(self, name: str) -> bool:
        """Whether inverse kinematics reaches any grasp of the object, whatever stands around it."""
        T = self.world.pose(name)
        for grasp in self.grasps(name).grasps[::4]:
            T_goal = T @ grasp.T_stand_tcp
            if self.kinematics.inverse(T_goal, self.kinematics.seeds_toward(T_goal, 2), name=name).converged:
                return True
        return False

    def _no_plan(self, name: str, tally: _Tally) -> str:
        found = self.grasps(name)
        if not found.grasps:
            return found.why_none(name)
        remedy = "clear its surroundings or move the box"
        if tally.reasons and tally.reasons.most_common(1)[0][0] == "out of reach":
            remedy = "move it closer to the arm"
        return f"No plan for {name}: of {tally.tried} ways tried, {tally.text()}; {remedy}"

    def _picks(self, name: str, tried: Collection[Grasp], tally: _Tally) -> Iterator[Pick]:
        """Ways to take the object, best grasp first, spread over the azimuths."""
        for grasp in self.grasps(name).grasps:
            if any(_alike(grasp, other) for other in tried):
                continue
            pick = find_pick(self.motions, name, grasp, self.config.handling)
            if isinstance(pick, str):
                tally.fail(pick)
            else:
                yield pick

    def _complete(
        self, pick: Pick, placement: Placement, q_start: np.ndarray, tally: _Tally
    ) -> PickPlacePlan | None:
        """A whole plan for one way to take the object: the first yaw at the goal that works."""
        name, grasp = placement.name, pick.grasp
        for yaw in self._ordered_yaws(pick, placement)[:6]:
            T_rest = self.resting_pose(placement, yaw)
            place = find_place(self.motions, pick, self.items[name], placement, T_rest, self.config.handling)
            if isinstance(place, str):
                tally.fail(place)
                continue
            self.world.carry(name, np.linalg.inv(grasp.T_stand_tcp))
            carry = self.motions.free_way(
                pick.lift[-1], place.lowering[0], grasp.held_width, self.config.transit_margins
            )
            if carry is None:
                tally.fail("blocked on the way to the goal")
                continue
            self.world.release()
            start = self.motions.free_way(
                q_start, pick.approach[0], grasp.opening, self.config.transit_margins
            )
            if start is None:
                tally.fail("blocked on the way to the object")
                return None
            return self._timed(pick, place, placement, T_rest, start, carry)
        return None

    def _ordered_yaws(self, pick: Pick, placement: Placement) -> list[float]:
        """Yaws at the goal, those first that turn the hand no further than the arm's base turns anyway."""
        T_stand_tcp = pick.grasp.T_stand_tcp
        T_now = self.world.pose(placement.name)
        now, goal = T_now[:2, 3], np.array(placement.position[:2])
        swing = np.arctan2(goal[1], goal[0]) - np.arctan2(now[1], now[0])
        hand_now = _heading(T_now @ T_stand_tcp)

        def turn(yaw: float) -> float:
            hand = _heading(pose_from_yaw(yaw, np.zeros(3)) @ T_stand_tcp)
            return abs(float(np.angle(np.exp(1j * (hand - hand_now - swing)))))

        return sorted(placement.yaws, key=turn)

    def _timed(
        self,
        pick: Pick,
        place: Place,
        placement: Placement,
        T_rest: np.ndarray,
        start: list[np.ndarray],
        carry: list[np.ndarray],
    ) -> PickPlacePlan | None:
        """The plan with all its motions timed."""
        approach = [self.motions.timed_line(pick.approach)]
        if np.abs(start[0] - start[-1]).max() > 1e-6:
            approach.insert(0, self.motions.timed_way(start))
        return PickPlacePlan(
            name=placement.name,
            grasp=pick.grasp,
            placement=placement,
            T_world_stand_goal=place.T_world_stand_goal,
            T_world_stand_rest=T_rest,
            release_opening=place.release_opening,
            approach=concatenate(approach),
            lift=self.motions.timed_line(pick.lift),
            transfer=concatenate([self.motions.timed_way(carry), self.motions.timed_line(place.lowering)]),
            settle=None if place.settle is None else self.motions.timed_line(place.settle),
            retreat=self.motions.timed_line(place.retreat),
        )


def _alike(first: Grasp, second: Grasp) -> bool:
    """Whether two grasps would meet the same fate: the same hold within 20 degrees and 3 mm of depth."""
    turn = abs(np.angle(np.exp(1j * (first.azimuth - second.azimuth))))
    return bool(
        first.kind == second.kind and turn < np.deg2rad(20) and abs(first.depth - second.depth) < 0.003
    )


def _heading(T_world_tcp: np.ndarray) -> float:
    """Direction of the hand's x about the vertical in [rad]."""
    return float(np.arctan2(T_world_tcp[1, 0], T_world_tcp[0, 0]))
