"""MuJoCo models of the bare arm for kinematics and collision checking, reduced from ``ArmDescription.mjcf``.

MuJoCo's extension modules have no type stubs; type checkers see them as ``Any``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Float

from manipulation.errors import ManipulationError
from manipulation.robot import ArmDescription

mujoco: Any = importlib.import_module("mujoco")

if TYPE_CHECKING:
    MjSpec: TypeAlias = Any
    MjsBody: TypeAlias = Any
    MjModel: TypeAlias = Any
else:
    MjSpec, MjsBody, MjModel = mujoco.MjSpec, mujoco.MjsBody, mujoco.MjModel

COLLISION_GROUP = 3


def collision_spec(mjcf: str) -> MjSpec:
    """Return the arm as an editable MuJoCo specification with its collision geoms (group 3) only.

    Visual geoms, lights, actuators, sensors, equalities, tendons, keyframes and excludes are removed.
    """
    spec = mujoco.MjSpec.from_string(mjcf)
    for elements in (spec.keys, spec.sensors, spec.actuators, spec.equalities, spec.tendons, spec.excludes):
        for element in list(elements):
            spec.delete(element)
    for geom in list(spec.geoms):
        if geom.group != COLLISION_GROUP:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH}
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
    for light in list(spec.lights):
        spec.delete(light)
    # Links whose inertia came from deleted geoms must still compile; the model is never simulated.
    spec.compiler.boundmass = 1e-3
    spec.compiler.boundinertia = 1e-6
    return spec


def kinematic_model(arm: ArmDescription) -> MjModel:
    """Return the compiled kinematic chain: arm joints and sites, fixed fingers, no geoms."""
    spec = collision_spec(arm.mjcf)
    for geom in list(spec.geoms):
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for joint in list(spec.joints):
        if joint.name not in arm.joint_names:
            spec.delete(joint)
    return spec.compile()


def joint_addresses(model: MjModel, names: tuple[str, ...]) -> np.ndarray:
    """Return the qpos indices of the named hinge or slide joints, in the order of the names.

    Raises:
        ManipulationError: the model has no joint of that name.
    """
    addresses = []
    for name in names:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if index < 0:
            raise ManipulationError(f"the arm's MJCF has no joint '{name}'")
        addresses.append(model.jnt_qposadr[index])
    return np.asarray(addresses, dtype=np.int64)


def site_index(model: MjModel, name: str) -> int:
    """Return the index of the named site.

    Raises:
        ManipulationError: the model has no site of that name.
    """
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if index < 0:
        raise ManipulationError(f"the arm's MJCF has no site '{name}'")
    return index


def joint_range(model: MjModel, names: tuple[str, ...]) -> Float[np.ndarray, "2 n"]:
    """Return the lower and upper position limits of the named joints in [rad]."""
    limits = [model.joint(name).range for name in names]
    return np.asarray(limits, dtype=np.float64).T
