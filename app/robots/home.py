"""Search for a home posture: hand over the table, pointing down, away from limits and collisions."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from manipulation.collision import CollisionWorld
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE
from manipulation.robot import ArmDescription
from manipulation.workspace import hand_down

SHARES = (0.55, 0.45, 0.65, 0.35)  # of the arm's length: distances of the hand from the base
YAWS = (0.0, np.pi, np.pi / 2, -np.pi / 2)  # [rad] of the hand; the camera looks ahead first
HEIGHTS = (0.40, 0.30, 0.22, 0.50)  # of the arm's length: heights of the hand above the table
_SEEDS = 6  # random start postures for each place
_GOOD = 0.45  # [rad] from the limits; more is no better
_ENOUGH = -0.1  # score at which no other yaw of the hand is tried


def arm_length(kinematics: Kinematics) -> float:
    """Return the greatest distance [m] of the hand from the shoulder over random postures."""
    rng = np.random.default_rng(0)
    postures = rng.uniform(kinematics.lower, kinematics.upper, (400, len(kinematics.lower)))
    shoulder = kinematics.anchors(np.asarray(kinematics.arm.q_home))[1]
    return max(float(np.linalg.norm(kinematics.forward(q)[:3, 3] - shoulder)) for q in postures)


def find_home(arm: ArmDescription, kinematics: Kinematics) -> Float[np.ndarray, "n"] | None:
    """Return a home posture in [rad], the best over a few places in front of the base; None if none is free.

    Args:
        arm: the arm; its own home posture is not used.
        kinematics: its kinematics.
    """
    world = CollisionWorld(arm, [], (TABLE,))
    length = arm_length(kinematics)
    rng = np.random.default_rng(0)
    low, high = np.maximum(kinematics.lower, -np.pi), np.minimum(kinematics.upper, np.pi)
    best, best_score = None, -np.inf
    for yaw in YAWS:
        for share, height, _ in itertools.product(SHARES, HEIGHTS, range(_SEEDS)):
            place = kinematics.base[0] + share * length, kinematics.base[1], height * length
            T = hand_down(place, yaw)
            result = kinematics.inverse(T, [rng.uniform(low, high)], name="the home posture")
            if not result.converged or world.contact(result.q, arm.max_width) is not None:
                continue
            score = _score(kinematics, result.q)
            if score > best_score:
                best, best_score = result.q, score
        if best_score > _ENOUGH:
            return best
    return best


def _score(kinematics: Kinematics, q: np.ndarray) -> float:
    """Return the distance to the limits, less a little for postures that are low, twisted or not planar.

    An elbow below the wrist is low wherever it is: it meets the table where the hand reaches down.
    """
    anchors = kinematics.anchors(q)
    sideways = float(np.ptp(anchors[1:, 1]))
    lowest = float(anchors[2:, 2].min())
    low = max(0.0, 0.15 - lowest) + max(0.0, float(anchors[-1, 2]) - lowest)
    twist = float(np.abs(q).max())
    middle = 0.5 * (kinematics.lower[0] + kinematics.upper[0])
    off = 0.15 * abs(float(q[0] - middle))  # room to turn to both sides
    return min(kinematics.limit_distance(q), _GOOD) - 0.5 * sideways - low - 0.06 * twist - off
