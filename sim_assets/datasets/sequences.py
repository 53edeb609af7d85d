"""Synthetic RGB-D sequences: a camera moves over a table with objects of the test families.

As in NodeSLAM's evaluation: objects stand upright at random places, and a smooth trajectory leads through
sampled camera positions and look-at points. Colour and depth are rendered; no physics.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline

from perception.types import Category, RgbdFrame
from sim_assets.cell.layout import PlanarPose, Region, quat_from_yaw, sample_layout
from sim_assets.datasets.scatter import simplified
from sim_assets.objects import ObjectModel, sample_object
from sim_assets.rendering.camera import OPENCV_FROM_MUJOCO, OffscreenRenderer, intrinsics_of, look_at
from sim_assets.rendering.depth_noise import DepthNoise, add_depth_noise
from sim_assets.rendering.headless import MjSpec, mujoco
from sim_assets.rendering.materials import Finish, add_material, add_mesh, random_finish, wood

CAMERA = "eye"
RATE = 30.0  # [Hz]
_DENSE = 200  # interpolated poses between two sampled ones


@dataclass(frozen=True)
class SequenceConfig:
    """Distribution that a sequence is sampled from.

    Attributes:
        width, height, fovy: Size of the images in pixels, and their vertical field of view in degrees.
        frames: Number of frames.
        objects: Number of objects.
        categories: Classes of the objects, assigned in turn.
        spread: Half side of the square that the objects are placed in, in metres.
        gap: Smallest distance between the outlines of objects, in metres.
        distance, elevation: Range of the sampled camera positions relative to their look-at points, in metres
            and radians.
        azimuth_step: Range of the angle about the vertical between successive positions, in radians.
        look_at: Half side of the square over the table that look-at points are sampled in, in metres.
        step, turn: Motion of the camera between frames, whichever is reached first, in metres and radians.
        depth_noise: Noise model of the depth.
        moved_at: Frame from which one object has another pose, as if displaced by hand; None for never.
    """

    width: int = 320
    height: int = 240
    fovy: float = 45.0
    frames: int = 150
    objects: int = 10
    categories: tuple[Category, ...] = ("mug", "bowl", "bottle")
    spread: float = 0.30
    gap: float = 0.03
    distance: tuple[float, float] = (0.55, 0.85)
    elevation: tuple[float, float] = (np.radians(35), np.radians(65))
    azimuth_step: tuple[float, float] = (np.radians(25), np.radians(70))
    look_at: float = 0.12
    step: float = 0.012
    turn: float = np.radians(1.2)
    depth_noise: DepthNoise = "gaussian"
    moved_at: int | None = None


CLOSE_UP = SequenceConfig(distance=(0.32, 0.42), look_at=0.20, frames=100, step=0.010, turn=np.radians(1.0))


@dataclass(frozen=True)
class PlacedObject:
    """A true object with its pose."""

    model: ObjectModel
    T_world_object: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class SequenceFrame:
    """One image with its ground truth.

    Attributes:
        frame: Colour, noisy depth, and the true camera pose.
        instances: Index of the object at each pixel, -1 for none.
    """

    frame: RgbdFrame
    instances: Int[np.ndarray, "h w"]


class TableSequence:
    """A scene and a trajectory, determined by the seed; every rendering gives the same images.

    Attributes:
        config: Distribution that it was sampled from.
        objects: True objects with their final poses.
        moved: Index of the object that is displaced at ``config.moved_at``, or None.
        Ts_world_camera: True trajectory.
        rate: Frame rate, in hertz.
    """

    def __init__(self, seed: int | np.random.SeedSequence, config: SequenceConfig | None = None) -> None:
        self.config = config or SequenceConfig()
        root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        self._noise_seed, scene, path = root.spawn(3)
        rng = np.random.default_rng(scene)
        self.objects = _draw_objects(self.config, rng)
        self.Ts_world_camera = sample_trajectory(self.config, np.random.default_rng(path))
        self.rate = RATE
        self._model = _build(self.objects, self.config.fovy, rng).compile()
        self.moved: int | None = None
        if self.config.moved_at is not None:
            self.moved, self.objects = _move_one(self.objects, self.config.gap, rng)

    def render(self) -> Iterator[SequenceFrame]:
        """Render the images in order."""
        config, rng = self.config, np.random.default_rng(self._noise_seed)
        model, data = self._model, mujoco.MjData(self._model)
        object_of_geom = np.full(model.ngeom + 1, -1, dtype=np.int32)  # last entry: geom -1, the sky
        for index in range(len(self.objects)):
            object_of_geom[model.geom(f"object{index}").id] = index
        intrinsics = intrinsics_of(config.width, config.height, config.fovy)
        view = (data, CAMERA, config.width, config.height)
        start = np.array(model.body_pos)
        renderer = OffscreenRenderer(model)
        try:
            for index, T_world_camera in enumerate(self.Ts_world_camera):
                _aim(model, T_world_camera)
                if index == config.moved_at and self.moved is not None:
                    body = model.body(f"object{self.moved}").id
                    model.body_pos[body] = self.objects[self.moved].T_world_object[:3, 3]
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                rgb = renderer.color(*view, reflections=False)
                depth, ids = renderer.depth_and_ids(*view)
                depth = add_depth_noise(depth, config.depth_noise, intrinsics, rng, rgb)
                frame = RgbdFrame(index / RATE, rgb, depth, intrinsics, T_world_camera)
                yield SequenceFrame(frame, object_of_geom[ids])
        finally:
            model.body_pos[:] = start
            renderer.close()


def sample_trajectory(config: SequenceConfig, rng: np.random.Generator) -> Float[np.ndarray, "n 4 4"]:
    """Sample T_world_camera of every frame: cubic splines through sampled positions and look-at points.

    Successive frames are ``config.step`` or ``config.turn`` apart, whichever is reached first.
    """
    azimuth, direction = rng.uniform(-np.pi, np.pi), rng.choice((-1.0, 1.0))
    positions, targets = [], []
    poses = np.zeros((0, 4, 4))
    while len(poses) < config.frames:
        for _ in range(4):
            target = np.array([*rng.uniform(-config.look_at, config.look_at, 2), rng.uniform(0.02, 0.08)])
            elevation, distance = rng.uniform(*config.elevation), rng.uniform(*config.distance)
            level = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
            positions.append(target + distance * np.array([*level, np.sin(elevation)]))
            targets.append(target)
            direction = -direction if rng.random() < 0.2 else direction
            azimuth += direction * rng.uniform(*config.azimuth_step)
        knots = np.arange(len(positions))
        at = np.linspace(0, knots[-1], _DENSE * (len(knots) - 1))
        eyes, looks = CubicSpline(knots, positions)(at), CubicSpline(knots, targets)(at)
        poses = _evenly(np.stack([look_at(eye, look) for eye, look in zip(eyes, looks)]), config)
    return poses[: config.frames]


def perturbed_poses(
    Ts_world_camera: Float[np.ndarray, "n 4 4"],
    rng: np.random.Generator,
    sigma_move: float = 0.001,
    sigma_turn: float = np.radians(0.1),
) -> Float[np.ndarray, "n 4 4"]:
    """Return poses with Gaussian errors [m], [rad]; the defaults are the paper's for Fusion++."""
    noisy = np.array(Ts_world_camera)
    for T in noisy:
        x, y, z = rng.normal(0, sigma_turn, 3)
        turn = np.array([[1, -z, y], [z, 1, -x], [-y, x, 1]])  # orthonormal but for squares of the angles
        u, _, vt = np.linalg.svd(T[:3, :3] @ turn)
        T[:3, :3] = u @ vt
        T[:3, 3] += rng.normal(0, sigma_move, 3)
    return noisy


def _evenly(poses: Float[np.ndarray, "n 4 4"], config: SequenceConfig) -> Float[np.ndarray, "m 4 4"]:
    """Return the subset of dense poses that is one allowed step or turn apart."""
    moves = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    relative = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    turns = np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1))
    effort = np.concatenate([[0], np.cumsum(np.maximum(moves / config.step, turns / config.turn))])
    return poses[np.searchsorted(effort, np.arange(0, effort[-1], 1.0))]


def _draw_objects(config: SequenceConfig, rng: np.random.Generator) -> tuple[PlacedObject, ...]:
    wanted: list[Category] = [config.categories[i % len(config.categories)] for i in range(config.objects)]
    models = [sample_object(category, "test", rng) for category in wanted]
    side = (-config.spread, config.spread)
    region = Region(side, side, max_radius=2 * config.spread)
    places: Sequence[PlanarPose] = sample_layout([m.mesh for m in models], rng, region, config.gap)
    return tuple(PlacedObject(model, place.matrix) for model, place in zip(models, places, strict=True))


_DISPLACEMENT = (0.09, 0.14)  # [m] range of the displacement of an object by hand


def _move_one(
    objects: tuple[PlacedObject, ...], gap: float, rng: np.random.Generator
) -> tuple[int, tuple[PlacedObject, ...]]:
    """Move one of the inner objects to a free place nearby; return its index and all objects afterwards."""
    places = np.array([item.T_world_object[:2, 3] for item in objects])
    radii = np.array([np.abs(item.model.mesh.bounds[:, :2]).max() for item in objects])
    while True:
        index = int(rng.choice(np.argsort(np.linalg.norm(places, axis=1))[: (len(objects) + 1) // 2]))
        angle, length = rng.uniform(-np.pi, np.pi), rng.uniform(*_DISPLACEMENT)
        there = places[index] + length * np.array([np.cos(angle), np.sin(angle)])
        room = np.linalg.norm(places - there, axis=1) - radii - radii[index]
        if np.delete(room, index).min(initial=np.inf) > 0.5 * gap:
            break
        gap *= 0.99  # a crowded table: the required gap shrinks until a place is found
    T = np.array(objects[index].T_world_object)
    T[:2, 3] = there
    moved = PlacedObject(objects[index].model, T)
    return index, (*objects[:index], moved, *objects[index + 1 :])


def _aim(model, T_world_camera: np.ndarray) -> None:
    eye = model.camera(CAMERA).id
    model.cam_pos[eye] = T_world_camera[:3, 3]
    mujoco.mju_mat2Quat(model.cam_quat[eye], (T_world_camera[:3, :3] @ OPENCV_FROM_MUJOCO).ravel())


def _build(objects: Sequence[PlacedObject], fovy: float, rng: np.random.Generator) -> MjSpec:
    """Build table, floor, light, camera and objects for rendering; nothing collides."""
    spec = mujoco.MjSpec()
    spec.modelname = "table_sequence"
    spec.compiler.degree = False
    spec.stat.extent, spec.stat.center = 1.0, (0, 0, 0)
    spec.visual.map.znear, spec.visual.map.zfar = 0.05, 20
    spec.visual.quality.shadowsize = 1024
    spec.visual.quality.offsamples = 0  # faster; colour is for display only
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = (0.36, 0.36, 0.38), (0.15, 0.15, 0.15)
    grain = Finish(wood(rng, (0.62, 0.46, 0.32), (768, 768)), specular=0.12, shininess=0.3, reflectance=0.0)
    add_material(spec, "table", grain)
    floor = spec.add_material(name="floor", rgba=(0.58, 0.58, 0.60, 1))
    world, box = spec.worldbody, mujoco.mjtGeom.mjGEOM_BOX
    world.add_geom(name="table", type=box, size=(0.75, 0.65, 0.02), pos=(0, 0, -0.02), material="table")
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(5, 5, 0.1),
        pos=(0, 0, -0.75),
        material=floor.name,
    )
    world.add_light(
        name="key", type=mujoco.mjtLightType.mjLIGHT_SPOT, pos=(0.7, -0.9, 1.8), dir=(-0.35, 0.45, -0.9),
        castshadow=True, cutoff=60, exponent=1, diffuse=(0.62, 0.60, 0.57), ambient=(0, 0, 0),
    )  # fmt: skip
    world.add_camera(name=CAMERA, fovy=fovy)
    for index, item in enumerate(objects):
        name = f"object{index}"
        add_mesh(spec, name, simplified(item.model.mesh, 0.0003))
        add_material(spec, name, random_finish(rng, item.model.category))
        yaw = float(np.arctan2(item.T_world_object[1, 0], item.T_world_object[0, 0]))
        body = world.add_body(name=name, pos=item.T_world_object[:3, 3], quat=quat_from_yaw(yaw))
        body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0
        )
    return spec
