"""MuJoCo model of the collision world: the arm's MJCF and the perceived meshes alone.

Every object has two bodies, one in the world and one attached to the hand, of which at most one is enabled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.arm_model import MjsBody, MjSpec, collision_spec, mujoco
from manipulation.hulls import hull_faces, reduced_hull
from manipulation.obstacles import TABLE, Obstacle
from manipulation.robot import ArmDescription
from manipulation.self_collision import link_contacts
from perception.obstacles.obstacle import PerceivedObstacle

# Contact bits: links and carried objects collide with the world, links with links.
OFF, ROBOT, WORLD, LINK = 0, 1, 2, 4


@dataclass(frozen=True)
class Body:
    """An object as a union of convex pieces.

    Attributes:
        name: unique identifier in the collision world.
        pieces: (k, 3) vertices of each piece in the object frame in [m].
        T_world_object: (4, 4) initial pose.
    """

    name: str
    pieces: tuple[Float[np.ndarray, "_k 3"], ...]
    T_world_object: Float[np.ndarray, "4 4"]


def collision_model(
    arm: ArmDescription,
    bodies: Sequence[Body],
    obstacles: Sequence[Obstacle | PerceivedObstacle],
    perceived_margin: float,
) -> MjSpec:
    """Return the model of an arm, objects and obstacles, with objects in the world enabled.

    Args:
        arm: description of the arm.
        bodies: objects; the body "world/NAME" of each is in the world, "carried/NAME" attached to the hand.
        obstacles: static obstacles, bodies "world/NAME".
        perceived_margin: margin of the geoms of perceived obstacles in [m].
    """
    spec = collision_spec(arm.mjcf)
    for geom in spec.geoms:
        # Fixed links touch the table they are mounted on.
        movable = geom.parent.name != "world" and _has_joint_above(geom.parent)
        geom.contype, geom.conaffinity = (ROBOT | LINK, WORLD | LINK) if movable else (LINK, LINK)
    contacts = link_contacts(arm)
    for first, second in contacts.ignored:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    hand = spec.site(arm.tcp_site).parent
    for obstacle in obstacles:
        if isinstance(obstacle, PerceivedObstacle):
            _add_perceived(spec, obstacle, perceived_margin)
            continue
        body = spec.worldbody.add_body(name=f"world/{obstacle.name}", pos=obstacle.center)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=obstacle.half_size,
            contype=WORLD,
            conaffinity=ROBOT,
        )
        if obstacle.name == TABLE.name:
            for link in contacts.level:
                spec.add_exclude(bodyname1=link, bodyname2=body.name)
    for body in bodies:
        standing = spec.worldbody.add_body(name=f"world/{body.name}")
        carried = hand.add_body(name=f"carried/{body.name}")
        for index, vertices in enumerate(body.pieces):
            name = f"{body.name}/{index}"
            mesh = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=hull_faces(vertices))
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            mesh_type = mujoco.mjtGeom.mjGEOM_MESH
            standing.add_geom(type=mesh_type, meshname=name, contype=WORLD, conaffinity=ROBOT, mass=0)
            carried.add_geom(type=mesh_type, meshname=name, contype=OFF, conaffinity=OFF, mass=0)
    return spec


def _add_perceived(spec: MjSpec, obstacle: PerceivedObstacle, margin: float) -> None:
    body = spec.worldbody.add_body(name=f"world/{obstacle.name}")
    for index, piece in enumerate(obstacle.pieces):
        name, vertices = f"{obstacle.name}/{index}", reduced_hull(piece)
        mesh = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=hull_faces(vertices))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            contype=WORLD,
            conaffinity=ROBOT,
            margin=margin,
        )


def _has_joint_above(body: MjsBody) -> bool:
    while body is not None and body.name != "world":
        if len(body.joints) > 0:
            return True
        body = body.parent
    return False
