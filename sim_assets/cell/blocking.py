"""Why an arm does not follow its command: something is in the way, or a servo is at its torque limit."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.finger_motion import is_below

_SATURATED = 0.98  # share of the torque limit
_PUSH = 1.0  # [N] of a contact that counts


def blocking_reason(model: MjModel, data: Any, joint: str, actuator: int, first: str) -> str:
    """Return what keeps a joint from its command, at the moment it falls behind.

    Args:
        model, data: the scene.
        joint: name of the joint.
        actuator: index of its servo.
        first: name of the arm's first joint; the bodies below it are the arm and its hand.
    """
    obstacles = touched(model, data, int(model.joint(first).bodyid[0]))
    if obstacles:
        return f"the arm is blocked by {', '.join(obstacles)}"
    limit = float(np.abs(model.actuator_forcerange[actuator]).max())
    force = abs(float(data.actuator_force[actuator]))
    if model.actuator_forcelimited[actuator] and force > _SATURATED * limit:
        return (
            f"the servo of {joint} is at its limit of {limit:.3g} Nm and nothing is in the way (lower "
            "velocity and acceleration, raise torque, or carry less)"
        )
    return "the arm is blocked"


def touched(model: MjModel, data: Any, root: int) -> list[str]:
    """Return what pushes against the arm below a body, or against what it holds, with the parts that touch.

    An object in contact with the hand alone is held, and no obstacle.
    """
    arm = {body for body in range(model.nbody) if is_below(model, body, root)}
    pairs = [pair for i in range(data.ncon) if (pair := _pushing(model, data, i)) is not None]
    held = {b for a, b in _ordered(pairs, arm) if model.body_dofnum[b] == 6}
    found = {}
    for a, b in _ordered(pairs, arm | held):
        found[f"{_called(model, b)} at {_called(model, a)}"] = None
    return list(found)


def _pushing(model: MjModel, data: Any, index: int) -> tuple[int, int] | None:
    """Return the bodies of a contact that carries a force; None for others."""
    wrench = np.zeros(6)
    mujoco.mj_contactForce(model, data, index, wrench)
    if wrench[0] < _PUSH:
        return None
    first, second = data.contact.geom[index]
    return int(model.geom_bodyid[first]), int(model.geom_bodyid[second])


def _ordered(pairs: list[tuple[int, int]], inside: set[int]) -> list[tuple[int, int]]:
    """Return the pairs of which one body is inside the set and the other is not, that one first."""
    turned = [(a, b) if a in inside else (b, a) for a, b in pairs]
    return [(a, b) for a, b in turned if a in inside and b not in inside]


def _called(model: MjModel, body: int) -> str:
    if model.body_dofnum[body] == 6:
        return "an object"
    return model.body(body).name if body else "the table"
