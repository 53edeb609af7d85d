"""The planner's model of an arm: its kinematic chain and collision geoms, written from the compiled model.

Compiled values are free of default classes, frames, fitted shapes and mesh files.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sim_assets.rendering.headless import MjModel, MjSpec, mujoco
from sim_assets.robots.mounting import PREFIX, Frame
from sim_assets.robots.pedestal import Pedestal
from sim_assets.robots.solid_geoms import COLLISION_GROUP


def planning_mjcf(model: MjModel, base: Frame, pedestal: Pedestal | None = None) -> str:
    """Return the arm as self-contained MJCF; its names have the prefix of scenes.

    Args:
        model: compiled arm; its collision geoms have a non-zero ``contype``.
        base: pose of the arm's world in the scene's.
        pedestal: column under the arm; None for an arm on the table.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "arm"
    spec.compiler.degree = False
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-6
    if pedestal is not None:
        column = spec.worldbody.add_body(name=f"{PREFIX}pedestal")
        column.add_geom(name=f"{PREFIX}pedestal", group=COLLISION_GROUP, **pedestal.shape)
    bodies = [spec.worldbody.add_body(name=f"{PREFIX}mount", pos=base.position, quat=base.quaternion)]
    for index in range(1, model.nbody):
        body = bodies[model.body_parentid[index]].add_body(
            name=PREFIX + model.body(index).name, pos=model.body_pos[index], quat=model.body_quat[index],
            mass=max(model.body_mass[index], 1e-3),
            ipos=model.body_ipos[index], iquat=model.body_iquat[index],
            inertia=np.maximum(model.body_inertia[index], 1e-6), explicitinertial=True,
        )  # fmt: skip
        bodies.append(body)
    for index in range(model.njnt):
        bodies[model.jnt_bodyid[index]].add_joint(
            name=PREFIX + model.joint(index).name, type=mujoco.mjtJoint(int(model.jnt_type[index])),
            pos=model.jnt_pos[index], axis=model.jnt_axis[index], range=model.jnt_range[index],
            limited=bool(model.jnt_limited[index]),
        )  # fmt: skip
    for index in range(model.nsite):
        if model.site(index).name:
            bodies[model.site_bodyid[index]].add_site(
                name=PREFIX + model.site(index).name, pos=model.site_pos[index], quat=model.site_quat[index]
            )
    for index in np.flatnonzero(model.geom_contype):
        _add_geom(spec, bodies[model.geom_bodyid[index]], model, int(index))
    spec.compile()
    return spec.to_xml()


def _add_geom(spec: MjSpec, body: Any, model: MjModel, index: int) -> None:
    shape: dict[str, Any] = {"size": model.geom_size[index]}
    if model.geom_type[index] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[index])
        shape = {"meshname": f"mesh_{mesh}"}
        if spec.mesh(shape["meshname"]) is None:
            start = model.mesh_vertadr[mesh]
            vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
            spec.add_mesh(
                name=shape["meshname"], uservert=vertices.astype(np.float32).ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
            )  # fmt: skip
    body.add_geom(
        name=PREFIX + model.geom(index).name, type=mujoco.mjtGeom(int(model.geom_type[index])),
        pos=model.geom_pos[index], quat=model.geom_quat[index], group=COLLISION_GROUP, mass=0, **shape,
    )  # fmt: skip
