"""Objects and things of no class as free bodies: inertia, convex collision geoms, contact parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
import trimesh

from sim_assets.cell.layout import FreePose, PlanarPose
from sim_assets.objects import CollisionPiece
from sim_assets.rendering.headless import MjsBody, MjSpec, mujoco
from sim_assets.rendering.materials import Finish, add_material, add_mesh

OBJECT_CONTACT = {
    "friction": (0.6, 0.005, 0.0001), "condim": 4, "contype": 1, "conaffinity": 3,
    "solref": (0.006, 1), "solimp": (0.95, 0.99, 0.001, 0.5, 2), "group": 3,
}  # fmt: skip
# without rolling friction, a lying can never comes to rest
ROLLING_CONTACT = {**OBJECT_CONTACT, "condim": 6, "friction": (0.6, 0.005, 0.001)}

_GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}


Pose = PlanarPose | FreePose


@runtime_checkable
class Solid(Protocol):
    """What has a mesh [m], convex collision pieces and a mass [kg]: an object or a thing of no class."""

    @property
    def mesh(self) -> trimesh.Trimesh: ...

    @property
    def collision(self) -> tuple[CollisionPiece, ...]: ...

    @property
    def mass(self) -> float: ...


def add_object(spec: MjSpec, name: str, model: Solid, place: Pose, finish: Finish) -> MjsBody:
    """Add an object as a free body with a visual mesh, convex collision geoms and the inertia of the mesh."""
    body = add_free_body(spec, name, model, place)
    add_mesh(spec, name, model.mesh)
    add_material(spec, name, finish)
    body.add_geom(
        name=f"{name}_visual", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name,
        contype=0, conaffinity=0, group=2, mass=0,
    )  # fmt: skip
    return body


def add_free_body(spec: MjSpec, name: str, model: Solid, place: Pose) -> MjsBody:
    """Add an object as a free body with convex collision geoms alone.

    Objects in a ``FreePose``, which may be round and lie on their side, have rolling friction.
    """
    center, inertia = _mass_properties(model)
    body = spec.worldbody.add_body(
        name=name, pos=place.position, quat=place.quat_wxyz,
        mass=model.mass, ipos=center, explicitinertial=True,
    )  # fmt: skip
    body.fullinertia = inertia
    body.add_freejoint(name=name)
    contact = ROLLING_CONTACT if isinstance(place, FreePose) else OBJECT_CONTACT
    for index, piece in enumerate(model.collision):
        _add_piece(spec, body, f"{name}_piece{index}", piece, contact)
    return body


def set_friction(spec: MjSpec, limits: tuple[float, float], rng: np.random.Generator) -> None:
    """Draw the sliding friction of the pads and of every free body; all else has the lower limit.

    MuJoCo takes the larger coefficient of two geoms, or that of the pads where they touch.
    """
    drawn: dict[str, float] = {}
    for geom in spec.geoms:
        body = geom.parent.name
        if geom.priority > 0:
            value = drawn.setdefault("pads", float(rng.uniform(*limits)))
        elif body.startswith(("object", "unknown")):
            value = drawn.setdefault(body, float(rng.uniform(*limits)))
        else:
            value = limits[0]
        geom.friction = (value, *geom.friction[1:])


def _add_piece(
    spec: MjSpec, body: MjsBody, name: str, piece: CollisionPiece, contact: Mapping[str, object]
) -> None:
    shape: dict[str, object] = {"size": tuple(piece.size) + (0.0,) * (3 - len(piece.size))}
    if piece.kind == "mesh":
        spec.add_mesh(
            name=name, uservert=np.asarray(piece.vertices, dtype=np.float32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )  # fmt: skip
        shape = {"meshname": name}
    body.add_geom(
        name=name, type=_GEOM_TYPES[piece.kind], pos=piece.position, quat=piece.quat_wxyz, mass=0,
        rgba=(0.3, 0.7, 0.3, 0.4), **shape, **contact,
    )  # fmt: skip


def _mass_properties(model: Solid) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return the centre of mass [m] and (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about it [kg m²]."""
    mesh = model.mesh
    inertia = mesh.moment_inertia * (model.mass / mesh.volume)
    return np.asarray(mesh.center_mass), (
        inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2],
    )  # fmt: skip
