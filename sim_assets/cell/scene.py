"""The cell: floor, table, open box, lights, cameras, the arm, and the objects as free bodies, in one MjSpec.

World frame: the robot's base, z up, table top at z = 0. Contact parameters were tuned by measurement: with
stiff pads and elliptic cones a grasped mug rotates by less than a degree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim_assets.cell.free_bodies import OBJECT_CONTACT, Pose, add_object
from sim_assets.cell.layout import quat_from_yaw
from sim_assets.cell.unknown import UnknownThing
from sim_assets.datasets.room import thing_finish
from sim_assets.objects import ObjectModel
from sim_assets.rendering.headless import MjSpec, mujoco
from sim_assets.rendering.materials import Finish, add_material, cardboard, random_finish, wood
from sim_assets.robots import panda
from sim_assets.robots.simulated_arm import SimulatedArm

TIMESTEP = 0.002  # [s]
TABLE_SIZE = (1.3, 1.2, 0.04)  # [m]
TABLE_CENTER = (0.45, 0.0)
TABLE_HEIGHT = 0.75  # [m], height of the table top above the floor
IMAGE_MAX = (1280, 960)  # size of the offscreen buffer, the largest possible image

SCENERY_CONTACT = {**OBJECT_CONTACT, "group": 1}


@dataclass(frozen=True)
class BoxConfig:
    """An open box on the table, aligned with x and y; lengths in [m].

    Attributes:
        inner: length (x), width (y) and depth of the interior.
        center: position (x, y) of the centre.
        wall, floor: thickness of the walls and of the floor.
    """

    inner: tuple[float, float, float] = (0.34, 0.30, 0.08)
    center: tuple[float, float] = (0.50, 0.27)
    wall: float = 0.008
    floor: float = 0.004

    def scaled(self, scale: float) -> BoxConfig:
        """Return the box of a similar cell, with walls of the same thickness."""
        length, width, depth = (scale * value for value in self.inner)
        x, y = (scale * value for value in self.center)
        return replace(self, inner=(length, width, depth), center=(x, y))


@dataclass(frozen=True)
class FixedCamera:
    """A fixed camera: position and target in [m], vertical field of view in [deg]."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    fovy: float = 45.0


VIEWS = {
    "overview": FixedCamera((1.52, -0.62, 0.88), (0.34, 0.02, 0.20), 45.0),
    "box": FixedCamera((0.98, -0.10, 0.58), (0.48, 0.25, 0.05), 38.0),
    "line": FixedCamera((1.02, 1.12, 0.66), (0.25, 0.27, 0.10), 42.0),
    "side": FixedCamera((0.55, -1.55, 0.62), (0.38, 0.0, 0.22), 43.0),
}


def build_scene(
    objects: Sequence[ObjectModel],
    places: Sequence[Pose],
    box: BoxConfig | None,
    rng: np.random.Generator,
    line: tuple[tuple[float, float], tuple[float, float]] | None = None,
    robot: SimulatedArm | None = None,
    unknown: Sequence[tuple[UnknownThing, Pose]] = (),
) -> MjSpec:
    """Build the specification of the cell.

    Args:
        objects, places: models and their poses; object i is the body ``object<i>``.
        unknown: things of no class and their poses; thing i is the body ``unknown<i>``.
        box: the open box; None for a table without one.
        rng: random generator of colours, patterns and wood grain.
        line: ends of the tape that marks the sorting line, without collision; None for no tape.
        robot: the arm; the Panda by default.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "cell"
    spec.compiler.degree = False
    set_physics(spec)
    _set_visuals(spec)
    _add_surroundings(spec)
    _add_table(spec, rng)
    if box is not None:
        _add_box(spec, box, rng)
    if line is not None:
        _add_tape(spec, np.array(line[0]), np.array(line[1]))
    (robot or panda()).add(spec)
    for index, (model, place) in enumerate(zip(objects, places, strict=True)):
        add_object(spec, f"object{index}", model, place, random_finish(rng, model.category))
    for index, (thing, place) in enumerate(unknown):
        add_object(spec, f"unknown{index}", thing, place, thing_finish(thing.mesh, rng))
    for name, view in VIEWS.items():
        _add_camera(spec, name, view)
    return spec


def set_physics(spec: MjSpec) -> None:
    """Set time step, integrator and contact solver."""
    option = spec.option
    option.timestep = TIMESTEP
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.impratio = 10


def _set_visuals(spec: MjSpec) -> None:
    spec.stat.extent = 1.5
    spec.stat.center = (0.45, 0, 0.2)
    visual = spec.visual
    visual.map.znear, visual.map.zfar = 0.01, 30
    visual.map.shadowscale = 0.58  # the shadow map covers the table, the cone more
    visual.quality.shadowsize = 2048
    visual.quality.offsamples = 4
    visual.headlight.ambient, visual.headlight.diffuse = (0.34, 0.34, 0.36), (0.16, 0.16, 0.16)
    visual.headlight.specular = (0, 0, 0)
    getattr(visual, "global").offwidth, getattr(visual, "global").offheight = IMAGE_MAX


def _add_surroundings(spec: MjSpec) -> None:
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.62, 0.70, 0.80), rgb2=(0.20, 0.25, 0.34), width=512, height=512,
    )  # fmt: skip
    spec.add_texture(
        name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.62, 0.62, 0.64), rgb2=(0.54, 0.55, 0.57), width=512, height=512,
        mark=mujoco.mjtMark.mjMARK_EDGE, markrgb=(0.50, 0.50, 0.52),
    )  # fmt: skip
    floor = spec.add_material(name="floor", reflectance=0.12, specular=0.2, texrepeat=(3, 3), texuniform=True)
    floor.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "tiles"
    world = spec.worldbody
    world.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(6, 6, 0.1), pos=(0, 0, -TABLE_HEIGHT),
        material="floor", **SCENERY_CONTACT,
    )  # fmt: skip
    spot = mujoco.mjtLightType.mjLIGHT_SPOT
    world.add_light(
        name="key", type=spot, pos=(1.15, -1.0, 2.5), dir=(-0.33, 0.43, -1.05), castshadow=True, cutoff=62,
        exponent=1, diffuse=(0.62, 0.60, 0.57), specular=(0.45, 0.45, 0.45), ambient=(0, 0, 0),
    )  # fmt: skip
    world.add_light(
        name="fill", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(-1.5, 1.5, 2.5), dir=(0.6, -0.5, -0.8), castshadow=False,
        diffuse=(0.20, 0.21, 0.24), specular=(0.05, 0.05, 0.05),
    )  # fmt: skip


def _add_table(spec: MjSpec, rng: np.random.Generator) -> None:
    grain = Finish(wood(rng, (0.62, 0.46, 0.32), (768, 768)), specular=0.12, shininess=0.3, reflectance=0.0)
    add_material(spec, "table", grain)
    dark = spec.add_material(name="table_frame", rgba=(0.16, 0.16, 0.18, 1), specular=0.4, shininess=0.5)
    length, width, thickness = TABLE_SIZE
    x, y = TABLE_CENTER
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(
        name="table", type=box, size=(length / 2, width / 2, thickness / 2), pos=(x, y, -thickness / 2),
        material="table", **SCENERY_CONTACT,
    )  # fmt: skip
    leg = (TABLE_HEIGHT - thickness) / 2
    for sign_x in (-1, 1):
        for sign_y in (-1, 1):
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=(0.025, leg, 0), material=dark.name,
                pos=(x + sign_x * (length / 2 - 0.07), y + sign_y * (width / 2 - 0.07), -thickness - leg),
                **_NO_COLLISION,
            )  # fmt: skip
    spec.worldbody.add_geom(
        type=box, size=(length / 2 - 0.05, width / 2 - 0.05, 0.02), pos=(x, y, -thickness - 0.02),
        material=dark.name, **_NO_COLLISION,
    )  # fmt: skip


_NO_COLLISION = {"contype": 0, "conaffinity": 0, "group": 1}


def _add_box(spec: MjSpec, box: BoxConfig, rng: np.random.Generator) -> None:
    add_material(
        spec, "box", Finish(cardboard(rng, (0.80, 0.66, 0.44)), specular=0.08, shininess=0.1), (2, 2)
    )
    (length, width, depth), wall = box.inner, box.wall
    body = spec.worldbody.add_body(name="box", pos=(*box.center, 0))
    height = (depth + box.floor) / 2
    panels = {
        "floor": ((0, 0, box.floor / 2), (length / 2, width / 2, box.floor / 2)),
        "front": ((length / 2 + wall / 2, 0, height), (wall / 2, width / 2 + wall, height)),
        "back": ((-length / 2 - wall / 2, 0, height), (wall / 2, width / 2 + wall, height)),
        "left": ((0, width / 2 + wall / 2, height), (length / 2, wall / 2, height)),
        "right": ((0, -width / 2 - wall / 2, height), (length / 2, wall / 2, height)),
    }
    for name, (center, half) in panels.items():
        body.add_geom(
            name=f"box_{name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=center,
            size=half,
            material="box",
            **SCENERY_CONTACT,
        )


def _add_tape(spec: MjSpec, start: np.ndarray, end: np.ndarray) -> None:
    """Add a flat strip without collision."""
    spec.add_material(name="tape", rgba=(0.16, 0.36, 0.62, 1), specular=0.3)
    along = end - start
    angle = float(np.arctan2(along[1], along[0]))
    spec.worldbody.add_geom(
        name="tape", type=mujoco.mjtGeom.mjGEOM_BOX, size=(np.linalg.norm(along) / 2, 0.006, 0.0002),
        pos=(*(start + end) / 2, 0.0002), quat=quat_from_yaw(angle), material="tape",
        **_NO_COLLISION,
    )  # fmt: skip


def _add_camera(spec: MjSpec, name: str, view: FixedCamera) -> None:
    position, target = np.array(view.position), np.array(view.target)
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross((0, 0, 1), backward)
    right /= np.linalg.norm(right)
    camera = spec.worldbody.add_camera(name=name, pos=view.position, fovy=view.fovy)
    camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
    camera.alt.xyaxes = (*right, *np.cross(backward, right))
