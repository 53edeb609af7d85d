"""Table-top scenes rendered by editing one compiled model in place; no arm, no physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Int

from perception.types import Category, RgbdFrame
from sim_assets.cell.layout import PlanarPose
from sim_assets.datasets.scatter import TableItem, scatter
from sim_assets.rendering.camera import OPENCV_FROM_MUJOCO, OffscreenRenderer, intrinsics_of, look_at
from sim_assets.rendering.depth_noise import DEPTH_NOISES, DepthNoise, add_depth_noise
from sim_assets.rendering.filament import FilamentRenderer
from sim_assets.rendering.headless import MjSpec, mujoco
from sim_assets.rendering.materials import (
    Finish,
    add_material,
    add_mesh,
    random_finish,
    random_ground,
)

Renderer = Literal["classic", "filament"]
CAMERA = "eye"
GROUND_SIZE = (256, 256)
SHOWN, HIDDEN = 2, 4  # geom groups
BELOW = -3.0  # height of hidden items, under the floor [m]


@dataclass(frozen=True)
class TrainingSceneConfig:
    """Distributions that table-top scenes are sampled from.

    Attributes:
        width, height: size of the images in pixels.
        pool, distractors: number of objects and of distractors compiled together.
        shares: relative frequencies of CATEGORIES among the objects of the pool.
        random_parts: share of the training split's distractors made by ``random_parts``.
        plain_tumblers: whether the bottles include straight tumblers with flat lids, which resemble cans.
        drawn_in: share of the training split's plain cans and canisters with a narrower foot.
        pictures_per_pool: number of images rendered with one pool.
        pictures_per_texture: number of images between changes of textures.
        textures_redrawn: number of items that get a new texture then; the ground always does.
        objects, extras: smallest and largest number of objects and of distractors in an image.
        gap: range of the minimum distance between neighbours in [m], sampled per image.
        crowded: share of images in which a random share of the items touch, or nearly touch, a neighbour.
        spread: range of the half side of the square that holds the items, in [m].
        distance, elevation, fovy: ranges of the camera's distance in [m], elevation in [rad] and vertical
            field of view in [deg].
        shadows: share of images with cast shadows (slower).
        upturned: share of images with a uniformly random camera roll.
        noises: probabilities of DEPTH_NOISES.
        renderer: renderer of the colour images; depth and instances always come from the classic one.
    """

    width: int = 320
    height: int = 240
    pool: int = 40
    distractors: int = 14
    shares: tuple[int, int, int, int] = (1, 1, 1, 1)
    random_parts: float = 0.0
    plain_tumblers: bool = True
    drawn_in: float = 0.0
    pictures_per_pool: int = 400
    pictures_per_texture: int = 8
    textures_redrawn: int = 12
    objects: tuple[int, int] = (3, 10)
    extras: tuple[int, int] = (0, 4)
    gap: tuple[float, float] = (0.002, 0.05)
    crowded: float = 0.6
    spread: tuple[float, float] = (0.18, 0.30)
    distance: tuple[float, float] = (0.35, 0.85)
    elevation: tuple[float, float] = (np.radians(30), np.radians(90))
    fovy: tuple[float, float] = (42.0, 50.0)
    shadows: float = 0.3
    upturned: float = 0.2
    noises: tuple[float, ...] = (0.1, 0.1, 0.35, 0.25, 0.2)
    renderer: Renderer = "classic"


@dataclass(frozen=True)
class InstanceLabel:
    """Ground truth of one item in an image.

    Attributes:
        category: class of the object; None for a distractor.
        T_world_object: (4, 4) pose, origin at the centre of its base, mug handle along +x.
        pixels: number of visible pixels.
        outline_pixels: area of the convex hull of its projection, occluded and truncated parts included.
        height: height of the item in [m].
    """

    category: Category | None
    T_world_object: Float[np.ndarray, "4 4"]
    pixels: int
    outline_pixels: float
    height: float

    @property
    def yaw(self) -> float:
        """Angle of the object's +x about the world's z in [rad]."""
        return float(np.arctan2(self.T_world_object[1, 0], self.T_world_object[0, 0]))


@dataclass(frozen=True)
class LabelledImage:
    """An RGB-D image with ground truth; the table is the plane z = 0 of the world.

    Attributes:
        frame: colour, noisy depth, intrinsics and pose of the camera.
        instances: (H, W) index into ``labels`` of the visible item, -1 for table and background.
        labels: all items on the table, visible or not.
    """

    frame: RgbdFrame
    instances: Int[np.ndarray, "h w"]
    labels: tuple[InstanceLabel, ...]


class TableTop:
    """One compiled model of a table with all items that may appear on it."""

    def __init__(self, items: list[TableItem], config: TrainingSceneConfig, rng: np.random.Generator) -> None:
        self.items, self.config = items, config
        self.model = _build(items, rng).compile()
        self.data = mujoco.MjData(self.model)
        self.renderer = OffscreenRenderer(self.model)
        self.filament = FilamentRenderer(self.model) if config.renderer == "filament" else None
        self.geoms = np.array([self.model.geom(f"item{i}").id for i in range(len(items))])
        self.item_of_geom = np.full(self.model.ngeom + 1, -1, dtype=np.int32)  # last: geom -1, the sky
        self.item_of_geom[self.geoms] = np.arange(len(items))

    def close(self) -> None:
        self.renderer.close()
        if self.filament is not None:
            self.filament.close()

    def redraw_textures(self, rng: np.random.Generator) -> None:
        """Give some of the items a new finish, and the ground a new texture."""
        for index in rng.choice(len(self.items), self.config.textures_redrawn, replace=False):
            item = self.items[index]
            finish = random_finish(rng, item.category or "", wild=0.5)
            self._set_texture(f"item{index}", finish.texture)
            material = self.model.material(f"item{index}").id
            self.model.mat_specular[material], self.model.mat_shininess[material] = (
                finish.specular,
                finish.shininess,
            )
        for name in ("table", "wall"):
            self._set_texture(name, random_ground(rng, GROUND_SIZE))
        if self.filament is not None:
            self.model.geom_group[self.geoms] = SHOWN  # geoms hidden at loading are never rendered
            self.filament.load()

    def _set_texture(self, name: str, image: np.ndarray) -> None:
        texture = self.model.texture(name).id
        start = self.model.tex_adr[texture]
        self.model.tex_data[start : start + image.size] = image.ravel()
        self.renderer.upload_texture(texture)

    def picture(self, rng: np.random.Generator) -> LabelledImage:
        config = self.config
        chosen = self._choose(rng)
        touching = rng.uniform(0.2, 0.9) if rng.random() < config.crowded else 0.0
        gap, spread = rng.uniform(*config.gap), rng.uniform(*config.spread)
        poses = scatter([self.items[i] for i in chosen], rng, gap, spread, touching)
        shown = [index for index, pose in zip(chosen, poses, strict=True) if pose is not None]
        placed = [pose for pose in poses if pose is not None]
        self.show(shown, placed)
        self.light(rng)
        fovy = rng.uniform(*config.fovy)
        T_world_camera = self._aim(placed, rng)
        shadows = rng.random() < config.shadows
        frame, ids = self.capture(T_world_camera, fovy, shadows, rng)
        row = np.full(len(self.items) + 1, -1, dtype=np.int32)
        row[shown] = np.arange(len(shown))
        instances = row[ids]
        pixels = np.bincount(instances[instances >= 0], minlength=len(shown))
        labels = tuple(
            self._label(self.items[i], pose, int(n), frame)
            for i, pose, n in zip(shown, placed, pixels, strict=True)
        )
        return LabelledImage(frame, instances, labels)

    def _label(self, item: TableItem, pose: PlanarPose, pixels: int, frame: RgbdFrame) -> InstanceLabel:
        assert frame.T_world_camera is not None
        T_camera_object = np.linalg.inv(frame.T_world_camera) @ pose.matrix
        corners = item.mesh.vertices @ T_camera_object[:3, :3].T + T_camera_object[:3, 3]
        k = frame.intrinsics
        image = corners[:, :2] / np.maximum(corners[:, 2:], 0.05) * (k.fx, k.fy)
        hull = cv2.convexHull(image.astype(np.float32))
        height = float(item.mesh.bounds[1, 2])
        return InstanceLabel(item.category, pose.matrix, pixels, float(cv2.contourArea(hull)), height)

    def capture(
        self,
        T_world_camera: Float[np.ndarray, "4 4"],
        fovy: float,
        shadows: bool,
        rng: np.random.Generator,
        noise: DepthNoise | None = None,
    ) -> tuple[RgbdFrame, Int[np.ndarray, "h w"]]:
        """Render the visible items: an RGB-D frame and the index of the item at each pixel (-1 for none).

        Args:
            T_world_camera: (4, 4) pose of the camera.
            fovy: vertical field of view in [deg].
            shadows: whether to render cast shadows.
            rng: random generator of the depth noise.
            noise: model of the depth noise; sampled from ``config.noises`` by default.
        """
        width, height = self.config.width, self.config.height
        eye = self.model.camera(CAMERA).id
        self.model.cam_pos[eye] = T_world_camera[:3, 3]
        mujoco.mju_mat2Quat(self.model.cam_quat[eye], (T_world_camera[:3, :3] @ OPENCV_FROM_MUJOCO).ravel())
        self.model.cam_fovy[eye] = fovy
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        view = (self.data, CAMERA, width, height)
        if self.filament is not None:
            rgb = self.filament.color(*view)
        else:
            rgb = cv2.GaussianBlur(self.renderer.color(*view, shadows=shadows), (3, 3), 0.5)
        depth, ids = self.renderer.depth_and_ids(*view)
        intrinsics = intrinsics_of(width, height, fovy)
        noise = noise or DEPTH_NOISES[rng.choice(len(DEPTH_NOISES), p=self.config.noises)]
        depth = add_depth_noise(depth, noise, intrinsics, rng, rgb)
        return RgbdFrame(0.0, rgb, depth, intrinsics, T_world_camera), self.item_of_geom[ids]

    def _choose(self, rng: np.random.Generator) -> list[int]:
        kind = np.array([item.category is not None for item in self.items])
        low, high = self.config.objects
        objects = rng.choice(np.flatnonzero(kind), rng.integers(low, high + 1), replace=False)
        low, high = self.config.extras
        extras = rng.choice(np.flatnonzero(~kind), rng.integers(low, high + 1), replace=False)
        return [int(i) for i in rng.permutation(np.concatenate([objects, extras]))]

    def show(self, shown: Sequence[int], placed: Sequence[PlanarPose]) -> None:
        """Place some of the items and hide all others."""
        self.model.geom_group[self.geoms] = HIDDEN
        self.model.body_pos[self.model.geom_bodyid[self.geoms], 2] = BELOW  # some renderers draw all groups
        self.model.geom_group[self.geoms[list(shown)]] = SHOWN
        for index, pose in zip(shown, placed, strict=True):
            body = self.model.body(f"item{index}").id
            self.model.body_pos[body] = (pose.x, pose.y, 0)
            self.model.body_quat[body] = pose.quat_wxyz

    def light(self, rng: np.random.Generator) -> None:
        """Randomise the lighting."""
        angle, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(0.1, 1.0)
        away = np.array([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.cos(tilt)])
        self.model.light_pos[0] = 1.8 * away
        self.model.light_dir[0] = -away
        tint = rng.normal(1, 0.06, 3)
        self.model.light_diffuse[0] = np.clip(rng.uniform(0.4, 1.1) * tint, 0, 1)
        self.model.light_specular[0] = rng.uniform(0.0, 0.9)
        headlight = self.model.vis.headlight
        headlight.ambient[:] = rng.uniform(0.2, 0.65)
        headlight.diffuse[:] = rng.uniform(0.0, 0.6)

    def _aim(self, placed: list[PlanarPose], rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
        """Return a random camera pose (OpenCV axes) that looks at a point near an item."""
        azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(*self.config.elevation)
        distance = rng.uniform(*self.config.distance)
        seen = placed[rng.integers(len(placed))] if placed else PlanarPose(0, 0, 0)
        target = rng.uniform(0.3, 1.0) * np.array([seen.x, seen.y, 0]) + (0, 0, rng.uniform(0, 0.08))
        away = np.array([
            np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ])  # fmt: skip
        upturned = rng.random() < self.config.upturned
        roll = rng.uniform(-np.pi, np.pi) if upturned else rng.normal(0, 0.15)
        return look_at(target + distance * away, target, roll)


def _build(items: list[TableItem], rng: np.random.Generator) -> MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = "table_top"
    spec.compiler.degree = False
    spec.stat.extent, spec.stat.center = 1.0, (0, 0, 0)
    spec.visual.map.znear, spec.visual.map.zfar = 0.05, 20
    spec.visual.quality.shadowsize = 1024
    spec.visual.quality.offsamples = 0  # twice as fast; a slight blur stands in for antialiasing
    blank = Finish(np.zeros((*GROUND_SIZE, 3), dtype=np.uint8), specular=0.1, shininess=0.2)
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=rng.uniform(0.2, 0.9, 3), rgb2=rng.uniform(0, 0.6, 3), width=128, height=128,
    )  # fmt: skip
    add_material(spec, "table", blank, (1, 1))
    add_material(spec, "wall", blank, (2, 2))
    world = spec.worldbody
    box, plane = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE
    world.add_geom(name="table", type=box, size=(0.75, 0.65, 0.02), pos=(0, 0, -0.02), material="table")
    world.add_geom(name="floor", type=plane, size=(5, 5, 0.1), pos=(0, 0, -0.7), material="wall")
    for sign in (-1, 1):
        world.add_geom(type=box, size=(0.02, 3, 1.2), pos=(sign * 2.2, 0, 0.5), material="wall")
    world.add_light(
        name="key",
        type=mujoco.mjtLightType.mjLIGHT_SPOT,
        castshadow=True,
        cutoff=60,
        exponent=1,
        ambient=(0, 0, 0),
    )
    world.add_camera(name=CAMERA)
    for index, item in enumerate(items):
        name = f"item{index}"
        add_mesh(spec, name, item.mesh)
        add_material(spec, name, random_finish(rng, item.category or "", wild=0.5))
        body = world.add_body(name=name)
        body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0
        )
    return spec
