"""Whether the free bodies of a cell rest as they were put: they may roll, but neither topple nor fall."""

from __future__ import annotations

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
    for name, before, now in zip(names, start, _poses(model, data.qpos, names), strict=True):
        turn = abs(tilt(now) - tilt(before))
        fall = float(before[2, 3] - now[2, 3])
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
