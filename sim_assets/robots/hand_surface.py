"""Points on a hand's collision geoms while its fingers move, and the shape that is measured on them.

Convention of the tool frame (TCP): z out of the hand, y the closing direction, origin between the pads; of a
hand with one moving jaw on the pad of the fixed one, y towards the moving one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from manipulation.robot import FingerMotion, GripperGeometry
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.finger_motion import HandSweep, is_below

_SPACING = 0.004  # [m] between points on a geom


@dataclass(frozen=True)
class HandShape:
    """Measured hand.

    Attributes:
        body: name of the body that carries the hand.
        T_body_tcp: (4, 4) pose of the tool frame in that body.
        geometry: dimensions for planning.
        fingers: joint positions over the opening between the pads.
        points: (n, 3) points on the hand's surface in the tool frame, fingers open, in [m].
    """

    body: str
    T_body_tcp: Float[np.ndarray, "4 4"]
    geometry: GripperGeometry
    fingers: FingerMotion
    points: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class HandSurface:
    """Points on the hand's collision geoms at every station of a sweep, in the hand body's frame.

    Attributes:
        points: (k, n, 3) in [m], stations from closed to open or reverse.
        body: (n,) body of each point.
        moves: (n,) whether the point moves with the fingers.
    """

    points: Float[np.ndarray, "k n 3"]
    body: Int[np.ndarray, "n"]
    moves: Bool[np.ndarray, "n"]


def hand_surface(model: MjModel, hand: int, sweep: HandSweep) -> HandSurface:
    """Return points on the collision geoms of body ``hand`` and of all below it, at every station.

    Raises:
        RobotFileError: there are no collision geoms.
    """
    geoms = [
        g
        for g in range(model.ngeom)
        if model.geom_contype[g] and is_below(model, int(model.geom_bodyid[g]), hand)
    ]
    if not geoms:
        raise RobotFileError("the hand has no collision geoms: there is nothing to grasp with")
    local = {g: geom_points(model, g) for g in geoms}
    data = mujoco.MjData(model)
    stations = []
    for qpos in sweep.qpos:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        R, p = data.xmat[hand].reshape(3, 3), data.xpos[hand]
        parts = [local[g] @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g] for g in geoms]
        stations.append((np.concatenate(parts) - p) @ R)
    points = np.array(stations)
    body = np.concatenate([np.full(len(local[g]), model.geom_bodyid[g]) for g in geoms])
    moving = {b for b in set(body.tolist()) if np.ptp(points[:, body == b], axis=0).max() > 1e-3}
    return HandSurface(points, body, np.isin(body, list(moving)))


def geom_points(model: MjModel, geom: int) -> Float[np.ndarray, "n 3"]:
    """Return points on a geom's surface, meshes by their convex hulls as in collision."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        start = model.mesh_vertadr[mesh]
        shape = trimesh.convex.convex_hull(model.mesh_vert[start : start + model.mesh_vertnum[mesh]])
    elif kind == types.mjGEOM_BOX:
        shape = trimesh.creation.box(extents=2 * size)
    elif kind == types.mjGEOM_SPHERE:
        shape = trimesh.creation.icosphere(2, float(size[0]))
    elif kind == types.mjGEOM_ELLIPSOID:
        shape = trimesh.creation.icosphere(2, 1.0)
        shape.apply_scale(size)
    elif kind == types.mjGEOM_CYLINDER:
        shape = trimesh.creation.cylinder(float(size[0]), float(2 * size[1]), sections=24)
    else:
        shape = trimesh.creation.capsule(float(2 * size[1]), float(size[0]), count=[16, 16])
    vertices = trimesh.remesh.subdivide_to_size(shape.vertices, shape.faces, _SPACING, max_iter=12)[0]
    kept = np.unique(np.round(vertices / (_SPACING / 4)).astype(np.int64), axis=0, return_index=True)[1]
    return vertices[kept]
