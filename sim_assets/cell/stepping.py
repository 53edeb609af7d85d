"""Time steps of the physics, and what MuJoCo says when they fail."""

from __future__ import annotations

import numpy as np

from sim_assets.cell.scene import TIMESTEP
from sim_assets.errors import SimAssetsError
from sim_assets.rendering.headless import MjData, MjModel, mujoco

_KINDS = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
_DIVERGED = np.array([int(getattr(mujoco.mjtWarning, f"mjWARN_{kind}")) for kind in _KINDS])


class SimulationError(SimAssetsError, RuntimeError):
    """The simulation diverged, or an unknown camera was requested."""


def advance(model: MjModel, data: MjData, duration: float) -> None:
    """Advance by ``duration`` [s], rounded to time steps, with the commands in ``data``.

    Raises:
        SimulationError: the physics diverged.
    """
    mujoco.mj_step(model, data, round(duration / TIMESTEP))
    check_warnings(data)


def check_warnings(data: MjData) -> None:
    """Raise if MuJoCo reset a diverged state, which it reports only as a warning count.

    Raises:
        SimulationError: the physics diverged.
    """
    counts = data.warning.number[_DIVERGED]
    if counts.any():
        kind = _KINDS[int(counts.argmax())].lower()
        raise SimulationError(f"the physics diverged at {data.time:.3f} s ({kind})")
