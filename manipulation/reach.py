"""Whether the arm reaches an object with any of its grasps, irrespective of collisions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manipulation.kinematics import Kinematics
from manipulation.types import GraspSet

_REACHED = 24  # number of grasps, evenly spread, that are checked: neighbours are similar
_SEEDS = 2


def reaches_any(
    kinematics: Kinematics, name: str, T_world_stand: Float[np.ndarray, "4 4"], grasps: GraspSet
) -> bool:
    """Return whether inverse kinematics reaches any grasp of an object.

    Args:
        kinematics: kinematics of the arm.
        name: name of the object.
        T_world_stand: its pose.
        grasps: its grasp candidates at that pose.
    """
    for grasp in grasps.grasps[:: max(1, len(grasps.grasps) // _REACHED)]:
        T_goal = T_world_stand @ grasp.T_stand_open
        if kinematics.inverse(T_goal, kinematics.seeds_toward(T_goal, _SEEDS), name=name).converged:
            return True
    return False
