"""Whether the free bodies of a cell rest where they were put."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from sim_assets.cell.resting import body_poses, is_still
from sim_assets.rendering.headless import MjData, MjModel

SHORTEST, LONGEST = 3.0, 8.0  # [s] of simulation: what topples slowly has begun to by the former
INTERVAL = 0.2  # [s] between two checks
FALLEN_TILT, FALLEN_HEIGHT = np.deg2rad(12), 0.03  # [rad], [m], largest change while settling


def settle_bodies(model: MjModel, data: MjData, names: Sequence[str], wait: Callable[[float], None]) -> str:
    """Advance until the free bodies are at rest; return which one fell or still moves, or an empty string.

    Args:
        model, data: the cell; the initial poses are those of the model.
        names: of the free bodies and of their joints.
        wait: advances the cell by a time in [s].
    """
    if not names:
        return ""
    start = _poses(model, model.qpos0, names)
    while data.time < SHORTEST or _moving(data, names):
        if data.time > LONGEST:
            return f"{_moving(data, names)[0]} does not come to rest"
        wait(INTERVAL)
    for name, before, now in zip(names, start, _poses(model, data.qpos, names), strict=True):
        turn = float(np.arccos(np.clip(now[:3, 2] @ before[:3, 2], -1, 1)))
        fall = float(before[2, 3] - now[2, 3])
        if turn > FALLEN_TILT or fall > FALLEN_HEIGHT:
            return f"{name} fell by {100 * fall:.0f} cm and turned by {np.rad2deg(turn):.0f} degrees"
    return ""


def _moving(data: MjData, names: Sequence[str]) -> list[str]:
    return [name for name in names if not is_still(data.joint(name).qvel)]


def _poses(
    model: MjModel, state: Float[np.ndarray, "q"], names: Sequence[str]
) -> tuple[Float[np.ndarray, "4 4"], ...]:
    starts = [int(model.joint(name).qposadr[0]) for name in names]
    return body_poses(np.concatenate([state[start : start + 7] for start in starts]))
