"""Motions one after another without a stop between them: each begins while the one before is slowing down.

In the overlap the displacements add up: q(t) = q1(t) + q2(t - t2) - q2(0). The arm leaves both paths there
and cuts the corner between them, by less the shorter the overlap. Whether that way is free is asked before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from manipulation.robot import JointTrajectory
from manipulation.trajectories import JointLimits, concatenate

_SHARES = (1.0, 0.7, 0.4)  # of the time in which the slower of the two changes its speed, tried in order
_SAMPLES = 8  # postures that represent a cut corner

Allows = Callable[[JointTrajectory], bool]


def blended(parts: Sequence[JointTrajectory], limits: JointLimits, allows: Allows) -> JointTrajectory:
    """Return one trajectory from several that each start at rest where the one before ends, without stops.

    Args:
        parts: motions in order.
        limits: joint limits, which hold in the overlaps as well.
        allows: whether the arm may move so around a corner, see ``corner_postures``.

    Raises:
        PlanningError: two of them do not meet.
    """
    joined = parts[0]
    for before, after in pairwise(parts):
        stopping = concatenate([joined, after])
        count = min(_stopping(before), _starting(after))
        cut = (_overlapping(joined, after, int(share * count)) for share in _SHARES if share * count >= 1)
        allowed = (whole for whole, around in cut if _keeps(around, limits) and allows(around))
        joined = next(allowed, stopping)
    return joined


def corner_postures(around: JointTrajectory) -> Float[np.ndarray, "k n"]:
    """Return postures [rad] along a cut corner, for its collision check; both ends are among them."""
    indices = np.linspace(0, len(around.positions) - 1, _SAMPLES).round().astype(int)
    return around.positions[np.unique(indices)]


def _starting(motion: JointTrajectory) -> int:
    """Return the number of periods in which a motion that begins at rest becomes faster."""
    speed = np.linalg.norm(motion.velocities, axis=1)
    return int(np.argmax(np.append(np.diff(speed) <= 1e-9, True)))


def _stopping(motion: JointTrajectory) -> int:
    """Return the number of periods in which a motion that ends at rest becomes slower before."""
    return _starting(motion.reversed())


def _overlapping(
    before: JointTrajectory, after: JointTrajectory, count: int
) -> tuple[JointTrajectory, JointTrajectory]:
    """Return both motions with ``count`` periods of them at the same time, and what the arm does in these."""
    start = len(before.positions) - count - 1
    end, begin = before.part(start), after.part(0, count + 1)
    around = JointTrajectory(
        before.period,
        end.positions + begin.positions - after.positions[0],
        end.velocities + begin.velocities,
        end.accelerations + begin.accelerations,
    )
    pieces = [before.part(0, start), around, after.part(count + 1)]
    whole = JointTrajectory(
        before.period,
        np.concatenate([piece.positions for piece in pieces]),
        np.concatenate([piece.velocities for piece in pieces]),
        np.concatenate([piece.accelerations for piece in pieces]),
    )
    return whole, around


def _keeps(motion: JointTrajectory, limits: JointLimits) -> bool:
    """Return whether velocities and accelerations are within the limits."""
    return bool(
        (np.abs(motion.velocities) <= limits.velocity).all()
        and (np.abs(motion.accelerations) <= limits.acceleration).all()
    )
