"""Candidates of a plan: similar grasps, the reasons of discarded candidates, and the order of yaws."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from manipulation.motions import OUT_OF_REACH
from manipulation.types import Grasp, GraspSet, Placement, Rejected
from perception.geometry import pose_from_yaw

NO_WAY = Rejected("without a collision-free path to the object")
_STEEP = -0.8  # vertical component of the approach, up to which the hand points down


@dataclass
class Tally:
    """Number of discarded candidates by reason, for error messages."""

    n_rejected: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    blockers: Counter[str] = field(default_factory=Counter)

    def reject(self, rejected: Rejected) -> None:
        """Count a discarded candidate."""
        self.n_rejected += 1
        self.reasons[rejected.reason] += 1
        if rejected.blocker:
            self.blockers[rejected.blocker] += 1

    @property
    def in_the_way(self) -> tuple[str, ...]:
        """Names of what discarded candidates collide with, the most frequent first."""
        return tuple(name for name, _ in self.blockers.most_common())

    @property
    def is_enclosed(self) -> bool:
        """Whether candidates were discarded because no path leads to them."""
        return self.reasons[NO_WAY.reason] > 0

    def failure_message(self, name: str, candidates: GraspSet) -> str:
        """Return the error message for an object without a plan: counts by reason and a remedy."""
        if not candidates.grasps:
            return candidates.failure_message(name)
        remedy = "clear its surroundings or move the box"
        if self.reasons and self.reasons.most_common(1)[0][0] == OUT_OF_REACH.reason:
            remedy = "move it closer to the arm"
        counts = ", ".join(f"{count} {reason}" for reason, count in self.reasons.most_common(5))
        return f"No plan for {name}: of {self.n_rejected} candidates, {counts}; {remedy}"


def are_similar(first: Grasp, second: Grasp) -> bool:
    """Return whether two grasps are of one kind and within 20 degrees and 3 mm of depth of each other."""
    angle = abs(np.angle(np.exp(1j * (first.azimuth - second.azimuth))))
    return bool(
        first.kind == second.kind and angle < np.deg2rad(20) and abs(first.depth - second.depth) < 0.003
    )


def ordered_yaws(
    T_now: Float[np.ndarray, "4 4"],
    T_goal: Float[np.ndarray, "4 4"],
    T_stand_tcp: Float[np.ndarray, "4 4"],
    placement: Placement,
) -> list[float]:
    """Return the yaws of a goal [rad] by the rotation of the hand beyond that of the arm's base.

    For a hand far from vertical, by the angle between its approach and the direction from the base.

    Args:
        T_now: Present T_world_stand of the object.
        T_goal: T_world_stand at rest at yaw 0.
        T_stand_tcp: Grasp.
        placement: Goal.
    """
    if (T_goal @ T_stand_tcp)[2, 2] > _STEEP:
        return _outward_yaws(T_goal @ T_stand_tcp, placement)
    now, goal = T_now[:2, 3], np.array(placement.position[:2])
    swing = np.arctan2(goal[1], goal[0]) - np.arctan2(now[1], now[0])
    hand_now = _heading(T_now @ T_stand_tcp)

    def turn(yaw: float) -> float:
        hand = _heading(pose_from_yaw(yaw, np.zeros(3)) @ T_stand_tcp)
        return abs(float(np.angle(np.exp(1j * (hand - hand_now - swing)))))

    return sorted(placement.yaws, key=turn)


def _outward_yaws(T_world_tcp: np.ndarray, placement: Placement) -> list[float]:
    """Return the yaws by the angle from outwards of the approach of a hand that has a pose at yaw 0."""
    approach = np.arctan2(T_world_tcp[1, 2], T_world_tcp[0, 2])
    outward = np.arctan2(placement.position[1], placement.position[0])
    return sorted(
        placement.yaws, key=lambda yaw: abs(float(np.angle(np.exp(1j * (approach + yaw - outward)))))
    )


def _heading(T_world_tcp: np.ndarray) -> float:
    """Return the azimuth [rad] of the hand's x axis."""
    return float(np.arctan2(T_world_tcp[1, 0], T_world_tcp[0, 0]))
