"""A bowl that leans in the one below it is pressed level: the closed hand pushes down its highest point.

Where it is jammed beside the middle of the lower bowl, that one tips up instead, and both fall back. The hand
then draws the point that it presses to the middle, which frees the bowl.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manipulation.collision import AllowedContacts
from manipulation.motions import MotionPlanner
from manipulation.trajectories import JointTrajectory
from manipulation.types import Rejected, StandingObject

LEANING = np.deg2rad(5.0)  # from which on a bowl is pressed; images show the tilt to about 2 degrees
PRESSABLE = np.deg2rad(26.0)  # up to which it is pressed anywhere; one that leans more may be levered out
LEVEL = np.deg2rad(8.0)  # up to which it stays as it is when pressing does not help
STEEPEST = np.deg2rad(35.0)  # that a bowl leans in another; images that show more were misunderstood
_ABOVE = 0.04  # [m] over the highest point, where the motion begins
_RISE = 0.004  # [m] error of the height at which a bowl is seen
_SURE = np.deg2rad(15.0)  # tilt that errors of a shape do not look like; 8 degrees were seen of a level bowl
_LOWER = 0.008  # [m] below its planned height, from which on a level bowl is where it is seen
_DEEPER = 0.002  # [m] below the rim's height at rest: the rim springs back
_INWARDS = 0.003  # [m] from the outline: fingertips must not slip off the rim
_WITHIN = 0.006  # [m] from the rim of the lower bowl, inside of which a press cannot lever the upper one out
_FURTHER = 0.004  # [m] beyond the middle, to which a bowl is drawn: it lags behind the fingertips
_DOWN = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))  # approach along -z, fingers close along y
_YAWS = np.deg2rad([0, 45, 90, -45])  # of the closed hand


@dataclass(frozen=True)
class Press:
    """Motions that press one point down.

    Attributes:
        transit: to above the point.
        down: to the height that the point has at rest.
        draw: to the middle of the lower bowl, at that height; None for a press alone.
        up: to the height above.
    """

    transit: JointTrajectory
    down: JointTrajectory
    draw: JointTrajectory | None
    up: JointTrajectory


def lean(T_world_stand: Float[np.ndarray, "4 4"]) -> float:
    """Return the angle [rad] between an object's axis and the vertical."""
    return float(np.arccos(np.clip(T_world_stand[2, 2], -1.0, 1.0)))


def is_plausible(seen: Mapping[str, Float[np.ndarray, "4 4"]]) -> bool:
    """Return whether bowls in one another can rest in the poses in which they were seen."""
    return all(lean(T) < STEEPEST for T in seen.values())


def can_lean(
    item: StandingObject, T_world_rest: Float[np.ndarray, "4 4"], T_world_stand: Float[np.ndarray, "4 4"]
) -> bool:
    """Return whether a bowl can lean as it was seen.

    It leans about a point of its outline, so that the middle of its base rises by at most the radius times
    the sine of the angle. What leans slightly and is seen higher is level: its shape was reconstructed too
    low, as what stands in something is hidden in part. A large tilt is no error of a shape.

    Args:
        item: the bowl.
        T_world_rest: its pose at rest.
        T_world_stand: the pose in which it was seen.
    """
    radius = float(np.linalg.norm(item.vertices[:, :2], axis=1).max())
    rise = float(T_world_stand[2, 3] - T_world_rest[2, 3])
    tilt = lean(T_world_stand)
    return bool(tilt >= _SURE or rise <= radius * np.sin(tilt) + _RISE)


def resting_height(T_world_rest: Float[np.ndarray, "4 4"], T_world_stand: Float[np.ndarray, "4 4"]) -> float:
    """Return the height [m] of a bowl's base, level in another one: as planned, unless it is seen lower.

    It was planned for the first contact at any yaw: between the corners of a polygon a bowl goes deeper. The
    middle of one that leans is not below its place; one that is level must be seen clearly lower.

    Args:
        T_world_rest: pose at rest as planned.
        T_world_stand: the pose in which it was seen.
    """
    planned, seen = float(T_world_rest[2, 3]), float(T_world_stand[2, 3])
    least = planned if lean(T_world_stand) >= LEANING else planned - _LOWER
    return seen if seen < least else planned


def lowest_leaning(names: Sequence[str], seen: Mapping[str, Float[np.ndarray, "4 4"]]) -> str | None:
    """Return the lowest bowl of a stack that is to be pressed; None if none leans.

    Those that are partly hidden are seen less exactly than the uppermost one.

    Args:
        names: the bowls from the uppermost down to the one on the ground, which does not lean.
        seen: their poses, by name.
    """
    limits = [LEANING, *[LEVEL] * (len(names) - 2)]
    leaning = [name for name, limit in zip(names, limits) if name in seen and lean(seen[name]) >= limit]
    return leaning[-1] if leaning else None


def is_pressable(
    item: StandingObject,
    T_world_stand: Float[np.ndarray, "4 4"],
    beneath: StandingObject,
    T_world_beneath: Float[np.ndarray, "4 4"],
) -> bool:
    """Return whether a press levels a leaning bowl: over the wall of the one below it would lever it out.

    Args:
        item: the bowl.
        T_world_stand: its pose.
        beneath: the bowl that it is in.
        T_world_beneath: the pose of that one.
    """
    if lean(T_world_stand) < PRESSABLE:
        return True
    aside = highest_rim_point(item, T_world_stand)[:2] - T_world_beneath[:2, 3]
    return bool(np.linalg.norm(aside) < _rim_radius(beneath) - _WITHIN)


def highest_rim_point(
    item: StandingObject, T_world_stand: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "3"]:
    """Return the highest point [m] of the rim of a leaning object, in the world frame."""
    axis = T_world_stand[:3, 2]
    uphill = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    radius = _rim_radius(item) - _INWARDS
    return T_world_stand[:3, 3] + item.top * axis + radius * uphill / max(np.linalg.norm(uphill), 1e-9)


def plan_press(
    motions: MotionPlanner,
    item: StandingObject,
    T_world_stand: Float[np.ndarray, "4 4"],
    T_world_rest: Float[np.ndarray, "4 4"],
    q_start: Float[np.ndarray, "n"],
    touched: frozenset[str],
    draws: bool = False,
) -> Press | None:
    """Return the motions that press a leaning object level, or None if no direction of the hand is free.

    Args:
        motions: plans motions of the closed hand.
        item: the object.
        T_world_stand: its pose, leaning.
        T_world_rest: the same where it belongs.
        q_start: present posture in [rad].
        touched: names of objects that the hand may touch: this one, and those that it leans on.
        draws: whether the point that is pressed is drawn to the middle.
    """
    kinematics, gripper = motions.kinematics, motions.kinematics.arm.gripper
    x, y, z = highest_rim_point(item, T_world_stand)
    inward = _inward(T_world_stand, T_world_rest, np.array([x, y])) if draws else np.zeros(2)
    allowed = AllowedContacts(touch=touched)
    for yaw in _YAWS + np.arctan2(y - kinematics.base[1], x - kinematics.base[0]):
        T_over, T_at = np.eye(4), np.eye(4)
        T_over[:3, :3] = T_at[:3, :3] = (Rotation.from_rotvec([0, 0, yaw]) * _DOWN).as_matrix()
        T_over[:3, 3] = x, y, z + gripper.tip + _ABOVE
        T_at[:3, 3] = x, y, T_world_rest[2, 3] + item.top + gripper.tip - _DEEPER
        over = kinematics.inverse(T_over, [q_start, *kinematics.seeds_toward(T_over, 2)], name=item.name)
        if not over.converged:
            continue
        down = motions.free_line(over.q, [T_at], gripper.min_width, allowed)
        if isinstance(down, Rejected):
            continue
        draw, up = None, down[::-1]
        if inward.any():
            draw = _aside(motions, down[-1], T_at, inward, allowed)
            back = None if draw is None else _aside(motions, draw[-1], T_over, inward, allowed)
            if back is None:
                continue
            up = back
        path = motions.free_path(q_start, over.q, gripper.min_width)
        if path is not None:
            drawn = None if draw is None else motions.time_line(draw, "pushed")
            return Press(
                motions.time_path(path), motions.time_line(down, "pushed"), drawn, motions.time_line(up)
            )
    return None


def _rim_radius(item: StandingObject) -> float:
    """Return the median radius [m] of an object near its rim."""
    upper = item.vertices[item.vertices[:, 2] > 0.8 * item.top]
    return float(np.median(np.linalg.norm(upper[:, :2], axis=1)))


def _inward(
    T_world_stand: Float[np.ndarray, "4 4"],
    T_world_rest: Float[np.ndarray, "4 4"],
    point: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "2"]:
    """Return the horizontal step [m] that draws a point of the rim, and its bowl, to where that belongs."""
    inward = T_world_stand[:2, 3] - point
    inward = inward / max(np.linalg.norm(inward), 1e-9)
    return (max(float((T_world_rest - T_world_stand)[:2, 3] @ inward), 0.0) + _FURTHER) * inward


def _aside(
    motions: MotionPlanner,
    q: Float[np.ndarray, "n"],
    T: Float[np.ndarray, "4 4"],
    step: Float[np.ndarray, "2"],
    allowed: AllowedContacts,
) -> Float[np.ndarray, "k n"] | None:
    """Return the postures [rad] of the closed hand straight to a pose moved aside by ``step`` [m]."""
    T_moved = T.copy()
    T_moved[:2, 3] += step
    line = motions.free_line(q, [T_moved], motions.kinematics.arm.gripper.min_width, allowed)
    return None if isinstance(line, Rejected) else line
