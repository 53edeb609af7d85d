"""Physics of toys dropped onto reconstructed objects, rendered from the recorded cameras.

All poses are in the recording's world frame, gravity along the support's normal. No ground
truth is used, so any recording works.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from perception.types import CameraIntrinsics, SupportPlane
from sim_assets.rendering.camera import OPENCV_FROM_MUJOCO, OffscreenRenderer
from sim_assets.rendering.headless import MjSpec, mujoco
from sim_assets.rendering.materials import add_mesh

TIMESTEP = 0.001  # [s]: a toy moves less than half a thin wall per step
GRAVITY = 9.81  # [m/s²]
DENSITY = 700.0  # density of toys [kg/m³]
ToyKind = Literal["ball", "die", "pill"]

_STATIC = {"friction": (0.7, 0.005, 0.0002), "solref": (0.005, 1), "solimp": (0.95, 0.99, 0.001, 0.5, 2)}
_BOUNCE: dict[ToyKind, tuple[float, float]] = {
    "ball": (0.008, 0.45),
    "die": (0.006, 0.9),
    "pill": (0.006, 0.8),
}
_GEOMS = {
    "ball": mujoco.mjtGeom.mjGEOM_SPHERE,
    "die": mujoco.mjtGeom.mjGEOM_BOX,
    "pill": mujoco.mjtGeom.mjGEOM_CAPSULE,
}


@dataclass(frozen=True)
class StaticObject:
    """A reconstructed object: mesh for occlusion and shadows, convex pieces for collision."""

    name: str
    mesh: trimesh.Trimesh
    pieces: Sequence[Float[np.ndarray, "_n 3"]]
    T_world_object: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Toy:
    """A falling toy.

    Attributes:
        kind: shape of the toy.
        size: radius of a ball or pill, half the side of a die [m].
        position: (3,) initial position of the centre in the world frame [m].
        release: time at which the toy appears and starts to fall [s].
        color: RGB in 0..1.
    """

    kind: ToyKind
    size: float
    position: Float[np.ndarray, "3"]
    release: float
    color: tuple[float, float, float]


@dataclass(frozen=True)
class HeightField:
    """Height field of unmodelled clutter on the support.

    Attributes:
        heights: (rows, columns) heights above the support [m], rows along the field's y.
        T_world_field: frame in the middle of the field on the support, z up.
        cell: side of a cell [m].
    """

    heights: Float[np.ndarray, "r c"]
    T_world_field: Float[np.ndarray, "4 4"]
    cell: float


@dataclass(frozen=True)
class RecordedCamera:
    """Intrinsics and pose of the camera of a recorded image."""

    intrinsics: CameraIntrinsics
    T_world_camera: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class DropRendering:
    """Rendering of the toys in a white world from one recorded camera.

    Attributes:
        color: (H, W, 3) image of coloured toys in white surroundings, with shadows.
        depth: (H, W) depth of the nearest surface [m], 0 for none.
        toys: (H, W) mask of pixels whose nearest surface belongs to a toy.
    """

    color: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    toys: Bool[np.ndarray, "h w"]


class DropWorld:
    """Physics simulation and renderer of the toys."""

    def __init__(
        self,
        objects: Sequence[StaticObject],
        toys: Sequence[Toy],
        plane: SupportPlane,
        T_world_support: Float[np.ndarray, "4 4"],
        views: Sequence[RecordedCamera],
        field: HeightField | None = None,
    ) -> None:
        """Build the world, with all toys unreleased.

        Args:
            T_world_support: a frame on the support in the middle of the scene, z along its normal.
        """
        self._toys = tuple(toys)
        spec = _scenery(plane, T_world_support)
        for item in objects:
            _add_static(spec, item)
        if field is not None and field.heights.max() > 0:
            _add_field(spec, field)
        for index, toy in enumerate(toys):
            _add_toy(spec, f"toy{index}", toy)
        for index, view in enumerate(views):
            _add_camera(spec, f"view{index}", view)
        self._views = tuple(views)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._renderer = OffscreenRenderer(self._model)
        self._geoms = np.array([self._model.geom(f"toy{i}").id for i in range(len(toys))], dtype=int)
        self._bodies = np.array([self._model.body(f"toy{i}").id for i in range(len(toys))], dtype=int)
        self._waiting = set(range(len(toys)))
        self._release()
        mujoco.mj_forward(self._model, self._data)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self._data.time)

    def positions(self) -> Float[np.ndarray, "t 3"]:
        """Return the centres of the toys in the world frame [m]."""
        return self._data.xpos[self._bodies].copy()

    def speeds(self) -> Float[np.ndarray, "t"]:
        """Return the speeds of the toys' centres [m/s]."""
        return np.linalg.norm(self._data.cvel[self._bodies, 3:], axis=1)

    def advance(self, seconds: float) -> None:
        """Advance the simulation by ``seconds``."""
        for _ in range(round(seconds / TIMESTEP)):
            self._release()
            mujoco.mj_step(self._model, self._data)

    def render(self, view: int, toys: bool = True) -> DropRendering:
        """Render from one of the cameras; without toys, the white surroundings alone."""
        camera = self._views[view].intrinsics
        colors = self._model.geom_rgba[self._geoms].copy()
        if not toys:
            self._model.geom_rgba[self._geoms, 3] = 0
        size = (camera.width, camera.height)
        try:
            color = self._renderer.color(self._data, f"view{view}", *size, reflections=False)
            depth, ids = self._renderer.depth_and_ids(self._data, f"view{view}", *size)
        finally:
            self._model.geom_rgba[self._geoms] = colors
        return DropRendering(color, depth, np.isin(ids, self._geoms))

    def close(self) -> None:
        """Free the GL context."""
        self._renderer.close()

    def _release(self) -> None:
        """Show and release the toys that are due; the others stay hidden."""
        for index in sorted(self._waiting):
            falls = self._data.time >= self._toys[index].release
            self._model.body_gravcomp[self._bodies[index]] = 0.0 if falls else 1.0
            self._model.geom_rgba[self._geoms[index], 3] = 1.0 if falls else 0.0
            contact = 1 if falls else 0
            self._model.geom_contype[self._geoms[index]] = contact
            self._model.geom_conaffinity[self._geoms[index]] = contact
            if falls:
                self._waiting.discard(index)


def _scenery(plane: SupportPlane, T_world_support: np.ndarray) -> MjSpec:
    """Build the white support and the lights above it."""
    spec = mujoco.MjSpec()
    spec.modelname = "drop"
    spec.compiler.degree = False
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.gravity = -GRAVITY * plane.normal
    spec.stat.extent, spec.stat.center = 0.7, T_world_support[:3, 3]
    visual = spec.visual
    visual.map.znear, visual.map.zfar = 0.02, 30
    visual.map.shadowclip, visual.quality.shadowsize = 0.8, 4096
    visual.quality.offsamples = 4
    visual.headlight.ambient, visual.headlight.diffuse = (0.42, 0.42, 0.42), (0.1, 0.1, 0.1)
    visual.headlight.specular = (0, 0, 0)
    spec.add_material(name="white", rgba=(0.85, 0.85, 0.85, 1), specular=0.0, shininess=0.0)
    world = spec.worldbody
    world.add_geom(
        name="support", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(3, 3, 0.1), material="white",
        pos=T_world_support[:3, 3], quat=_wxyz(T_world_support), group=1, **_STATIC,
    )  # fmt: skip
    up, side = T_world_support[:3, 2], T_world_support[:3, 0]
    world.add_light(
        name="above", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=T_world_support[:3, 3] + 1.5 * up,
        dir=-up + 0.25 * side, castshadow=True, diffuse=(0.6, 0.6, 0.6), specular=(0.5, 0.5, 0.5),
    )  # fmt: skip
    return spec


def _add_static(spec: MjSpec, item: StaticObject) -> None:
    body = spec.worldbody.add_body(
        name=item.name, pos=item.T_world_object[:3, 3], quat=_wxyz(item.T_world_object)
    )
    add_mesh(spec, item.name, item.mesh, textured=False)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=item.name,
        material="white",
        contype=0,
        conaffinity=0,
        group=1,
    )
    for index, corners in enumerate(item.pieces):
        name = f"{item.name}_{index}"
        spec.add_mesh(
            name=name, uservert=np.asarray(corners, dtype=np.float32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )  # fmt: skip
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=3, **_STATIC)


def _add_field(spec: MjSpec, field: HeightField) -> None:
    rows, columns = field.heights.shape
    low = float(field.heights.min())  # MuJoCo shifts the smallest elevation to 0 when it compiles
    span = float(field.heights.max()) - low or 1e-3
    surface = spec.add_hfield(
        name="clutter", nrow=rows, ncol=columns,
        size=(0.5 * field.cell * (columns - 1), 0.5 * field.cell * (rows - 1), span, 0.01),
    )  # fmt: skip
    surface.userdata = ((field.heights - low) / span).astype(np.float32).ravel()
    spec.worldbody.add_geom(
        name="clutter", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="clutter", group=3,
        pos=field.T_world_field[:3, 3] + (low - 0.001) * field.T_world_field[:3, 2],
        quat=_wxyz(field.T_world_field), **_STATIC,
    )  # fmt: skip


def _add_toy(spec: MjSpec, name: str, toy: Toy) -> None:
    spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_CUBE, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=toy.color, rgb2=tuple(0.45 * c + 0.5 for c in toy.color), width=64, height=64,
    )  # fmt: skip
    paint = spec.add_material(name=name, specular=0.6, shininess=0.8, rgba=(1, 1, 1, 1))
    paint.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
    body = spec.worldbody.add_body(name=name, pos=toy.position, gravcomp=1.0)
    body.add_freejoint()
    size = {"ball": (toy.size, 0, 0), "die": (toy.size,) * 3, "pill": (toy.size, toy.size, 0)}[toy.kind]
    body.add_geom(
        name=name, type=_GEOMS[toy.kind], size=size, material=name, density=DENSITY, group=2, condim=6,
        friction=(0.7, 0.005, 0.0002), solref=_BOUNCE[toy.kind], solimp=(0.95, 0.99, 0.001, 0.5, 2),
        priority=1,
    )  # fmt: skip


def _add_camera(spec: MjSpec, name: str, view: RecordedCamera) -> None:
    """Add a camera with the focal lengths and principal point of the image."""
    lens = view.intrinsics
    T = view.T_world_camera
    pose = np.eye(4)
    pose[:3, :3] = T[:3, :3] @ OPENCV_FROM_MUJOCO
    size = np.array([lens.width, lens.height])
    spec.worldbody.add_camera(
        name=name, pos=T[:3, 3], quat=_wxyz(pose), resolution=size, sensor_size=size * 1e-5,
        focal_pixel=(lens.fx, lens.fy),
        principal_pixel=((lens.width - 1) / 2 - lens.cx, (lens.height - 1) / 2 - lens.cy),
    )  # fmt: skip


def _wxyz(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4"]:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(T[:3, :3]).ravel())
    return quat
