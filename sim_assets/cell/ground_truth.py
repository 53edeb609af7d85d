"""Ground truth of a cell: poses, models, masks, contacts.

For scoring and label generation only; an import contract forbids it to all other modules.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from sim_assets.cell.world import IMAGE_SIZE, World
from sim_assets.objects import ObjectModel
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.finger_motion import is_below
from sim_assets.robots.simulated_arm import WRIST_CAMERA


def object_models(world: World) -> dict[int, ObjectModel]:
    """Return the object models by id."""
    return dict(enumerate(world.config.objects))


def object_poses(world: World) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return the current T_world_object of every object (origin at the centre of the base)."""
    return {index: _pose(world, f"object{index}") for index in object_models(world)}


def unknown_poses(world: World) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return the current T_world_thing of every thing of no class."""
    return {index: _pose(world, f"unknown{index}") for index in range(len(world.config.unknown))}


def _pose(world: World, name: str) -> Float[np.ndarray, "4 4"]:
    state = world._data.joint(name).qpos  # position, quaternion
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, state[3:])
    T_world_body = np.eye(4)
    T_world_body[:3, :3] = rotation.reshape(3, 3)
    T_world_body[:3, 3] = state[:3]
    return T_world_body


class ObjectStates:
    """Reads the state of all objects of a cell at once, for rewards and data sets.

    Raises:
        KeyError: the cell lacks an object.
    """

    def __init__(self, world: World) -> None:
        joints = [world._model.joint(f"object{index}") for index in object_models(world)]
        self._data = world._data
        self._position = np.array([joint.qposadr[0] for joint in joints], dtype=int)[:, None] + np.arange(7)
        self._velocity = np.array([joint.dofadr[0] for joint in joints], dtype=int)[:, None] + np.arange(6)

    def read(self) -> tuple[Float[np.ndarray, "n 7"], Float[np.ndarray, "n 6"]]:
        """Return positions [m] with quaternions wxyz, and linear [m/s] with angular [rad/s] velocities."""
        return self._data.qpos[self._position], self._data.qvel[self._velocity]


def instance_mask(world: World, camera: str = WRIST_CAMERA) -> Int[np.ndarray, "h w"]:
    """Return the id of the object visible at each pixel of a camera, -1 for none."""
    model = world._model
    of_geom = np.full(model.ngeom + 1, -1, dtype=np.int32)  # last entry: geom -1, the sky
    for index in object_models(world):
        of_geom[model.geom(f"object{index}_visual").id] = index
    _, ids = world._renderer.depth_and_ids(world._data, camera, *IMAGE_SIZE)
    return of_geom[ids]


def touching(world: World, index: int) -> set[str]:
    """Return the names of the bodies in contact with an object; ``world`` is table, floor and scenery."""
    model, data = world._model, world._data
    body = model.body(f"object{index}").id
    names = set()
    for contact in data.contact[: data.ncon]:
        bodies = model.geom_bodyid[contact.geom]
        if body in bodies:
            names.add(model.body(bodies[0] if bodies[1] == body else bodies[1]).name)
    return names


def held(world: World, index: int) -> bool:
    """Return whether an object is in contact with both fingers."""
    model = world._model
    hand = [model.joint(name).bodyid[0] for name in world.arm.fingers.joint_names]
    tcp = model.site(world.arm.tcp_site).id
    sides = set()
    for name in touching(world, index):
        body = model.body(name).id
        if any(is_below(model, body, int(finger)) for finger in hand):
            offset = world._data.xipos[body] - world._data.site_xpos[tcp]
            sides.add(bool(offset @ world._data.site_xmat[tcp].reshape(3, 3)[:, 1] > 0))
    return len(sides) == 2
