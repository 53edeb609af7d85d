"""Resting poses found by physics: bodies are lowered onto a table and simulated until they are at rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sim_assets.cell.free_bodies import Solid, add_free_body
from sim_assets.cell.layout import FreePose
from sim_assets.cell.scene import SCENERY_CONTACT, set_physics
from sim_assets.rendering.headless import MjModel, mujoco

LOWERING = 1.0  # [s] during which bodies sink slowly, so that they do not bounce or topple on impact
SINK_SPEED = 0.15  # [m/s]
TURNING = 0.1  # [m²] damping of rotations, relative to that of translations: bodies sink without turning
LONGEST = 5.0  # [s] of simulation
AT_REST = 1.0  # [s] without motion
STILL = (0.004, 0.05)  # largest speed [m/s] and angular speed [rad/s] of a body at rest


@dataclass(frozen=True)
class Settled:
    """Result of a simulation.

    Attributes:
        poses: T_world_object of every body at its end; the table is z = 0.
        at_rest: whether all bodies came to rest.
    """

    poses: tuple[Float[np.ndarray, "4 4"], ...]
    at_rest: bool


def settle(bodies: Sequence[tuple[Solid, Float[np.ndarray, "4 4"]]]) -> Settled:
    """Lower bodies from their T_world_object onto a table without anything else, until they are at rest."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    set_physics(spec)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=(1, 1, 0.1), pos=(0, 0, -0.1), **SCENERY_CONTACT
    )
    for index, (solid, T_world_object) in enumerate(bodies):
        add_free_body(spec, f"object{index}", solid, FreePose.of(T_world_object))
    model = spec.compile()
    data = mujoco.MjData(model)
    with damped(model, [f"object{index}" for index in range(len(bodies))]):
        mujoco.mj_step(model, data, round(LOWERING / model.opt.timestep))
    still_steps, needed = 0, round(AT_REST / model.opt.timestep)
    for _ in range(round((LONGEST - LOWERING) / model.opt.timestep)):
        mujoco.mj_step(model, data)
        still_steps = still_steps + 1 if is_still(data.qvel) else 0
        if still_steps >= needed:
            break
    return Settled(body_poses(data.qpos), still_steps >= needed)


@contextmanager
def damped(model: MjModel, names: Sequence[str]) -> Iterator[None]:
    """Let free bodies move as in honey: they sink, and those that start inside each other part slowly.

    Args:
        model: model with the bodies.
        names: of their free joints.
    """
    dofs = np.concatenate(
        [np.arange(6) + model.joint(name).dofadr[0] for name in names] or [np.empty(0, int)]
    )
    before = model.dof_damping[dofs].copy()
    masses = [model.body_mass[model.joint(name).bodyid[0]] for name in names]
    damping = np.repeat(np.array(masses)[:, None] * 9.81 / SINK_SPEED, 6, axis=1)
    damping[:, 3:] *= TURNING
    model.dof_damping[dofs] = damping.ravel()
    try:
        yield
    finally:
        model.dof_damping[dofs] = before


def tilt(T_world_object: Float[np.ndarray, "4 4"]) -> float:
    """Return the angle between the object's z and the vertical in [rad]."""
    return float(np.arccos(np.clip(T_world_object[2, 2], -1.0, 1.0)))


def is_still(velocities: Float[np.ndarray, "v"]) -> bool:
    """Return whether bodies are at rest, from the velocities of their free joints."""
    linear, angular = np.split(velocities.reshape(-1, 6), 2, axis=1)
    return bool(np.linalg.norm(linear, axis=1).max() < STILL[0]) and bool(
        np.linalg.norm(angular, axis=1).max() < STILL[1]
    )


def body_poses(states: Float[np.ndarray, "s"]) -> tuple[Float[np.ndarray, "4 4"], ...]:
    """Return T_world_object of every body from the positions of their free joints."""
    poses = []
    for state in states.reshape(-1, 7):
        T, rotation = np.eye(4), np.empty(9)
        mujoco.mju_quat2Mat(rotation, state[3:])
        T[:3, :3], T[:3, 3] = rotation.reshape(3, 3), state[:3]
        poses.append(T)
    return tuple(poses)
