"""The room of a table-top scene: table, floor, wall and surrounding things, varied by editing in place.

The things around the table belong to no instance: what stands beside or behind the support surface is not on
it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

from sim_assets.cell.layout import quat_from_yaw
from sim_assets.datasets.scene_config import GRIPPABLE_TABLE, RoomConfig
from sim_assets.rendering.headless import MjModel, MjSpec, mujoco
from sim_assets.rendering.materials import (
    Finish,
    add_material,
    add_mesh,
    distractor_finish,
    random_finish,
)

GROUND_SIZE = (256, 256)
GROUNDS = ("table", "floor", "wall")  # materials and textures
AROUND = "around"  # prefix of the bodies of things around the table
SHOWN, HIDDEN = 2, 4  # geom groups
BELOW = -3.0  # height of hidden things, under the floor [m]
_THICK = 0.02  # half the thickness of the table top [m]
_MARGIN = 0.04  # [m] between the outermost items and the edge of the table
_ASIDE = 1.0  # [m] that the wall at the side is farther away, so that no camera is behind it
_DROP = 0.7  # height of the table above the floor in rooms that are not varied [m]


def add_room(spec: MjSpec, surroundings: Sequence[trimesh.Trimesh], rng: np.random.Generator) -> None:
    """Add table, floor, walls and the surrounding things to a specification."""
    blank = Finish(np.zeros((*GROUND_SIZE, 3), dtype=np.uint8), specular=0.1, shininess=0.2)
    for name in GROUNDS:
        add_material(spec, name, blank, (1, 1) if name == "table" else (2, 2))
    world, types = spec.worldbody, mujoco.mjtGeom
    world.add_geom(
        name="table", type=types.mjGEOM_BOX, size=(*GRIPPABLE_TABLE, _THICK), pos=(0, 0, -_THICK),
        material="table",
    )  # fmt: skip
    world.add_geom(
        name="round", type=types.mjGEOM_CYLINDER, size=(GRIPPABLE_TABLE[0], _THICK, 0), pos=(0, 0, BELOW),
        material="table", group=HIDDEN,
    )  # fmt: skip
    world.add_geom(
        name="floor", type=types.mjGEOM_PLANE, size=(5, 5, 0.1), pos=(0, 0, -_DROP), material="floor"
    )
    for sign, name in ((-1, "wall"), (1, "far wall")):
        world.add_geom(
            name=name, type=types.mjGEOM_BOX, size=(0.02, 3, 1.2), pos=(sign * 2.2, 0, 0.5), material="wall"
        )
    for index, mesh in enumerate(surroundings):
        name = f"{AROUND}{index}"
        add_mesh(spec, name, mesh)
        add_material(spec, name, thing_finish(mesh, rng))
        body = world.add_body(name=name, pos=(0, 0, BELOW))
        body.add_geom(
            name=name, type=types.mjGEOM_MESH, meshname=name, material=name, group=HIDDEN, contype=0,
            conaffinity=0,
        )  # fmt: skip


def thing_finish(mesh: trimesh.Trimesh, rng: np.random.Generator) -> Finish:
    """Return a random finish for a thing of no class: that of its surfaces, if the mesh names them."""
    surfaces = mesh.metadata.get("surfaces", ())
    return distractor_finish(rng, surfaces, wild=0.15) if surfaces else random_finish(rng, wild=0.5)


class Room:
    """The room in a compiled model."""

    def __init__(
        self, model: MjModel, config: RoomConfig | None, surroundings: Sequence[trimesh.Trimesh]
    ) -> None:
        """Wrap a model made with ``add_room``; without a configuration the room never changes."""
        self._model, self._config = model, config
        self._reach = [float(np.linalg.norm(mesh.bounds[:, :2], axis=1).max()) for mesh in surroundings]

    def vary(self, rng: np.random.Generator, spread: float, azimuth: float) -> None:
        """Sample the table, the floor and what is around.

        Args:
            rng: source of randomness.
            spread: half the side of the square on the table that the items need, in [m].
            azimuth: direction from the table's centre to the camera in [rad].
        """
        config = self._config
        if config is None:
            return
        low = spread + _MARGIN
        half = np.maximum(np.exp(rng.uniform(np.log(config.side[0]), np.log(config.side[1]), 2)), low)
        on_ground, is_round = rng.random() < config.ground, rng.random() < config.round
        shift = rng.uniform(-1, 1, 2)
        if is_round:
            half[:] = max(half[0], low * np.sqrt(2))
            centre = shift / np.sqrt(2) * (half - low * np.sqrt(2))
        else:
            centre = shift * (half - low)
        yaw = rng.uniform(-np.pi, np.pi) if is_round else rng.normal(0, 0.02)
        self._place("table", not (on_ground or is_round), (*centre, -_THICK), (*half, _THICK), yaw)
        self._place("round", is_round and not on_ground, (*centre, -_THICK), (half[0], _THICK, 0), yaw)
        drop = 0.0 if on_ground else float(rng.uniform(*config.drop))
        self._model.geom_pos[self._model.geom("floor").id, 2] = -drop
        behind = azimuth + np.pi + rng.uniform(-0.6, 0.6)
        side = behind + rng.choice((-1, 1)) * np.pi / 2
        for name, angle, extra in (("wall", behind, 0.0), ("far wall", side, _ASIDE)):
            away = rng.uniform(*config.wall) + extra
            at = (away * np.cos(angle), away * np.sin(angle), 1.2 - drop)
            self._place(name, rng.random() < 0.8, at, (0.02, 3, 1.2), angle)
        reach = 0.0 if on_ground else float(np.hypot(*half))
        self._surround(rng, centre, max(reach, 1.4 * spread), drop, behind)

    def _surround(
        self, rng: np.random.Generator, centre: np.ndarray, clear: float, drop: float, behind: float
    ) -> None:
        """Place some of the things on the floor beyond ``clear`` metres around the table's centre."""
        assert self._config is not None
        few, most = self._config.things
        count = min(int(rng.integers(few, most + 1)), len(self._reach))
        chosen = set(rng.choice(len(self._reach), count, replace=False).tolist())
        for index, reach in enumerate(self._reach):
            geom, body = (getattr(self._model, kind)(f"{AROUND}{index}").id for kind in ("geom", "body"))
            self._model.geom_group[geom] = SHOWN if index in chosen else HIDDEN
            at = np.array([0.0, 0.0, BELOW])
            if index in chosen:
                angle, away = behind + rng.uniform(-1.3, 1.3), clear + reach + rng.exponential(0.5)
                at = np.array([*(centre + away * np.array([np.cos(angle), np.sin(angle)])), -drop])
            self._model.body_pos[body] = at
            self._model.body_quat[body] = quat_from_yaw(rng.uniform(-np.pi, np.pi))

    def _place(self, name: str, shown: bool, at: Sequence[float], size: Sequence[float], yaw: float) -> None:
        geom = self._model.geom(name).id
        self._model.geom_group[geom] = SHOWN if shown else HIDDEN
        self._model.geom_pos[geom] = at if shown else (0, 0, BELOW)
        self._model.geom_size[geom] = size
        self._model.geom_quat[geom] = quat_from_yaw(yaw)
