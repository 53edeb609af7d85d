"""The column under an arm whose base stands above the table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sim_assets.rendering.headless import MjModel, mujoco

LOWEST = 0.02  # [m] of a base above the table that needs no pedestal
HALF_WIDTH = 0.06  # [m]


@dataclass(frozen=True)
class Pedestal:
    """A square column on the table, in the scene's frame.

    Attributes:
        x, y: position of its axis in [m].
        height: height of its top in [m].
    """

    x: float
    y: float
    height: float

    @property
    def shape(self) -> dict[str, Any]:
        """Type, size and position of its geom."""
        half = 0.5 * self.height
        return {
            "type": mujoco.mjtGeom.mjGEOM_BOX,
            "size": (HALF_WIDTH, HALF_WIDTH, half),
            "pos": (self.x, self.y, half),
        }


def pedestal_of(model: MjModel, first: str, position: np.ndarray, quaternion: np.ndarray) -> Pedestal | None:
    """Return the pedestal that carries an arm; None for an arm that stands on the table.

    Args:
        model: compiled arm; its collision geoms have a non-zero ``contype``.
        first: name of the arm's first joint.
        position, quaternion: pose of the arm's file in the scene; [m], wxyz.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    turn = Rotation.from_quat(quaternion, scalar_first=True)
    joint = model.joint(first)
    foot = {0, int(joint.bodyid[0])}  # fixed bodies and those welded to the first link
    lowest = np.inf
    for geom in np.flatnonzero(model.geom_contype):
        if int(model.body_weldid[model.geom_bodyid[geom]]) in foot:
            corners = model.geom_aabb[geom, :3] + model.geom_aabb[geom, 3:] * _SIGNS
            corners = corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            lowest = min(lowest, float((turn.apply(corners) + position)[:, 2].min()))
    if not LOWEST < lowest < np.inf:
        return None
    x, y, _ = turn.apply(data.xanchor[joint.id]) + position
    return Pedestal(float(x), float(y), lowest - 0.001)


_SIGNS = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
