"""Whether the free bodies of a cell rest as they were put: they may roll, but neither topple nor fall."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sim_assets.cell.resting import body_poses, is_still, tilt
from sim_assets.cell.stepping import advance
from sim_assets.rendering.headless import MjData, MjModel

SHORTEST, LONGEST = 3.0, 8.0  # [s] of simulation: what topples slowly has begun to by the former
INTERVAL = 0.2  # [s] between two checks
FALLEN_TILT, FALLEN_HEIGHT = np.deg2rad(12), 0.03  # [rad], [m], largest change while settling
NUDGE, NUDGED = 0.15, 1.5  # [rad/s] about both horizontal axes, and the time [s] in which a fall has begun


@dataclass(frozen=True)
class Unsettled:
    """A body that does not rest as it was put.

    Attributes:
        name: name of the body.
        reason: what it did.
    """

    name: str
    reason: str


def settle_bodies(model: MjModel, data: MjData, names: Sequence[str]) -> Unsettled | None:
    """Advance until the free bodies are at rest; return one that fell or still moves, None without one.

    Args:
        model, data: the cell; the initial poses are those of the model.
        names: of the free bodies and of their joints.

    Raises:
        SimulationError: the physics diverged.
    """
    if not names:
        return None
    start = _poses(model, model.qpos0, names)
    while data.time < SHORTEST or _moving(data, names):
        if data.time > LONGEST:
            name = _moving(data, names)[0]
            return Unsettled(name, f"{name} does not come to rest")
        advance(model, data, INTERVAL)
    return _fallen(names, start, _poses(model, data.qpos, names))


def fallen_after_nudge(model: MjModel, data: MjData, names: Sequence[str]) -> Unsettled | None:
    """Return a body that falls after a slight turn to either side, None without one; ``data`` is not changed.

    What balances on a corner stands for seconds, and falls in the middle of a scan.

    Args:
        model, data: the cell, with all bodies at rest.
        names: of the free bodies and of their joints.

    Raises:
        SimulationError: the physics diverged.
    """
    start = _poses(model, data.qpos, names)
    for side in (1.0, -1.0):
        trial = copy.copy(data)
        for name, T in zip(names, start, strict=True):
            # The angular velocity of a free joint is in the frame of the body.
            trial.joint(name).qvel[3:] += T[:3, :3].T @ (side * np.array([NUDGE, NUDGE, 0.0]))
        advance(model, trial, NUDGED)
        fallen = _fallen(names, start, _poses(model, trial.qpos, names))
        if fallen is not None:
            return fallen
    return None


def _fallen(
    names: Sequence[str],
    before: Sequence[Float[np.ndarray, "4 4"]],
    after: Sequence[Float[np.ndarray, "4 4"]],
) -> Unsettled | None:
    for name, T_before, T in zip(names, before, after, strict=True):
        turn = abs(tilt(T) - tilt(T_before))
        fall = float(T_before[2, 3] - T[2, 3])
        if turn > FALLEN_TILT or fall > FALLEN_HEIGHT:
            how = f"fell by {100 * fall:.0f} cm and tilted by {np.rad2deg(turn):.0f} degrees"
            return Unsettled(name, f"{name} {how}")
    return None


def _moving(data: MjData, names: Sequence[str]) -> list[str]:
    return [name for name in names if not is_still(data.joint(name).qvel)]


def _poses(
    model: MjModel, state: Float[np.ndarray, "q"], names: Sequence[str]
) -> tuple[Float[np.ndarray, "4 4"], ...]:
    starts = [int(model.joint(name).qposadr[0]) for name in names]
    return body_poses(np.concatenate([state[start : start + 7] for start in starts]))
