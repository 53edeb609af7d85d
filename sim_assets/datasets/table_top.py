"""Table-top scenes rendered by editing one compiled model in place; no arm, no physics."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from perception.types import CameraIntrinsics, RgbdFrame
from sim_assets.datasets.labels import InstanceLabel, LabelledImage
from sim_assets.datasets.perceived import (
    TABLE,
    cut_depth,
    depth_scale,
    perceived_plane,
    perceived_points,
    table_pixels,
)
from sim_assets.datasets.room import (
    AROUND,
    BELOW,
    GROUND_SIZE,
    GROUNDS,
    HIDDEN,
    SHOWN,
    Room,
    add_room,
    thing_finish,
)
from sim_assets.datasets.scatter import TableItem, scatter
from sim_assets.datasets.scene_config import TrainingSceneConfig
from sim_assets.datasets.stacks import Stacks
from sim_assets.rendering.camera import OPENCV_FROM_MUJOCO, OffscreenRenderer, intrinsics_of, look_at
from sim_assets.rendering.depth_noise import DEPTH_NOISES, DepthNoise, add_depth_noise, nearest_depth
from sim_assets.rendering.depth_sensors.registration import misregister
from sim_assets.rendering.filament import FilamentRenderer
from sim_assets.rendering.headless import MjsBody, MjSpec, mujoco
from sim_assets.rendering.materials import (
    Finish,
    add_material,
    add_mesh,
    random_finish,
    random_ground,
)

CAMERA = "eye"
_ITEM = "item"  # prefix of the bodies, geoms and materials of items
_NOTHING, _SURROUNDING = -1, -2  # at pixels without an item
_STEP_BACK = 0.02  # [m]


class TableTop:
    """One compiled model of a table with all items that may appear on it."""

    def __init__(
        self,
        items: list[TableItem],
        config: TrainingSceneConfig,
        rng: np.random.Generator,
        surroundings: Sequence[trimesh.Trimesh] = (),
    ) -> None:
        """Compile the model; ``surroundings`` are z up, standing on z = 0, in [m]."""
        self.items, self.config = items, config
        self.stacks = Stacks(items)
        self.model = _build(items, surroundings, rng).compile()
        self.data = mujoco.MjData(self.model)
        self.room = Room(self.model, config.room, surroundings)
        self.renderer = OffscreenRenderer(self.model)
        self.filament = FilamentRenderer(self.model) if config.renderer == "filament" else None
        self.item_of_geom = np.full(self.model.ngeom + 1, _NOTHING, dtype=np.int32)  # last: the sky
        for geom in range(self.model.ngeom):
            body = self.model.body(self.model.geom_bodyid[geom]).name
            if body.startswith(_ITEM):
                self.item_of_geom[geom] = int(body.removeprefix(_ITEM))
            elif body.startswith(AROUND):
                self.item_of_geom[geom] = _SURROUNDING

    def close(self) -> None:
        self.renderer.close()
        if self.filament is not None:
            self.filament.close()

    def redraw_textures(self, rng: np.random.Generator) -> None:
        """Give some of the items a new finish, and table, floor and wall new textures."""
        for index in rng.choice(len(self.items), self.config.textures_redrawn, replace=False):
            finish = item_finish(self.items[index], rng)
            self._set_texture(f"{_ITEM}{index}", finish.texture)
            material = self.model.material(f"{_ITEM}{index}").id
            self.model.mat_specular[material], self.model.mat_shininess[material] = (
                finish.specular,
                finish.shininess,
            )
        for name in GROUNDS:
            self._set_texture(name, random_ground(rng, GROUND_SIZE))
        if self.filament is not None:
            self.model.geom_group[self._item_geoms()] = SHOWN  # geoms hidden at loading are never rendered
            self.filament.load()

    def _item_geoms(self) -> Int[np.ndarray, "g"]:
        return np.flatnonzero(self.item_of_geom[:-1] >= 0)

    def _set_texture(self, name: str, image: np.ndarray) -> None:
        texture = self.model.texture(name).id
        start = self.model.tex_adr[texture]
        self.model.tex_data[start : start + image.size] = image.ravel()
        self.renderer.upload_texture(texture)

    def picture(self, rng: np.random.Generator) -> LabelledImage:
        """Return an image of a random scene."""
        config = self.config
        chosen = self._choose(rng)
        touching = rng.uniform(0.2, 0.9) if rng.random() < config.crowded else 0.0
        gap, spread = rng.uniform(*config.gap), rng.uniform(*config.spread)
        poses = scatter([self.items[i] for i in chosen], rng, gap, spread, touching)
        shown = [index for index, pose in zip(chosen, poses, strict=True) if pose is not None]
        placed = [pose.matrix for pose in poses if pose is not None]
        if config.stacked > 0 and rng.random() < config.stacked:
            stacked = self.stacks.draw(shown, placed, rng)
            shown, placed = [*shown, *stacked], [*placed, *stacked.values()]
        self.show(shown, placed)
        self.light(rng)
        fovy = rng.uniform(*config.fovy)
        noise = DEPTH_NOISES[rng.choice(len(DEPTH_NOISES), p=config.noises)]
        heights = [
            float(pose[2, 3] + self.items[index].mesh.bounds[1, 2])
            for index, pose in zip(shown, placed, strict=True)
        ]
        T_world_camera = self._aim(placed, rng, heights, nearest_depth(noise))
        self.room.vary(rng, spread, float(np.arctan2(T_world_camera[1, 3], T_world_camera[0, 3])))
        true, ids = self.capture(T_world_camera, fovy, rng.random() < config.shadows)
        row = np.full(len(self.items) + 2, -1, dtype=np.int32)  # the last two: no item
        row[shown] = np.arange(len(shown))
        instances = row[ids]
        frame = self.sense(true, noise, rng)
        table = table_pixels(true, instances >= 0)
        exact = frame.intrinsics == true.intrinsics and noise in ("none", "gaussian")
        plane = TABLE if exact else perceived_plane(frame, table, rng)
        scale = 1.0 if exact else depth_scale(frame, true, table)
        pixels = np.bincount(instances[instances >= 0], minlength=len(shown))
        labels = tuple(
            self._label(self.items[i], pose, int(n), frame, true.intrinsics, scale)
            for i, pose, n in zip(shown, placed, pixels, strict=True)
        )
        return LabelledImage(frame, instances, labels, plane, ids == _SURROUNDING)

    def _label(
        self,
        item: TableItem,
        T_world_item: Float[np.ndarray, "4 4"],
        pixels: int,
        frame: RgbdFrame,
        camera: CameraIntrinsics,
        scale: float = 1.0,
    ) -> InstanceLabel:
        assert frame.T_world_camera is not None
        T_camera_object = np.linalg.inv(frame.T_world_camera) @ T_world_item
        corners = item.mesh.vertices @ T_camera_object[:3, :3].T + T_camera_object[:3, 3]
        image = corners[:, :2] / np.maximum(corners[:, 2:], 0.05) * (camera.fx, camera.fy)
        area = float(cv2.contourArea(cv2.convexHull(image.astype(np.float32))))
        foot = perceived_points(T_world_item[None, :3, 3], camera, frame, scale)[0]
        height = float(item.mesh.bounds[1, 2])
        return InstanceLabel(
            item.category, T_world_item, pixels, area, height, foot, item.ignored, item.resting
        )

    def capture(
        self, T_world_camera: Float[np.ndarray, "4 4"], fovy: float, shadows: bool
    ) -> tuple[RgbdFrame, Int[np.ndarray, "h w"]]:
        """Render the visible items: an RGB-D frame without noise and the item at each pixel.

        Pixels without an item are -1, those of things around the table -2.

        Args:
            T_world_camera: (4, 4) pose of the camera.
            fovy: vertical field of view in [deg].
            shadows: whether to render cast shadows.
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
        return RgbdFrame(0.0, rgb, depth, intrinsics, T_world_camera), self.item_of_geom[ids]

    def sense(self, true: RgbdFrame, noise: DepthNoise, rng: np.random.Generator) -> RgbdFrame:
        """Return the frame with the errors of a sensor and, in some images, of its calibration."""
        depth = add_depth_noise(true.depth, noise, true.intrinsics, rng, true.rgb)
        rgb, intrinsics = true.rgb, true.intrinsics
        if self.config.misregistered > 0 and rng.random() < self.config.misregistered:
            rgb, depth, intrinsics = misregister(rgb, depth, intrinsics, rng)
        if self.config.cut > 0 and rng.random() < self.config.cut:
            depth = cut_depth(depth, rng)
        return RgbdFrame(0.0, rgb, depth, intrinsics, true.T_world_camera)

    def _choose(self, rng: np.random.Generator) -> list[int]:
        kind = np.array([item.category is not None or item.ignored for item in self.items])
        low, high = self.config.objects
        objects = rng.choice(np.flatnonzero(kind), rng.integers(low, high + 1), replace=False)
        low, high = self.config.extras
        extras = rng.choice(np.flatnonzero(~kind), rng.integers(low, high + 1), replace=False)
        return [int(i) for i in rng.permutation(np.concatenate([objects, extras]))]

    def show(self, shown: Sequence[int], placed: Sequence[Float[np.ndarray, "4 4"]]) -> None:
        """Place some of the items at their T_world_item and hide all others."""
        geoms = self._item_geoms()
        here = np.isin(self.item_of_geom[geoms], list(shown))
        self.model.geom_group[geoms] = np.where(here, SHOWN, HIDDEN)
        self.model.body_pos[self.model.geom_bodyid[geoms], 2] = BELOW  # some renderers draw all groups
        for index, pose in zip(shown, placed, strict=True):
            body = self.model.body(f"{_ITEM}{index}").id
            self.model.body_pos[body] = pose[:3, 3]
            self.model.body_quat[body] = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)

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

    def _aim(
        self,
        placed: Sequence[Float[np.ndarray, "4 4"]],
        rng: np.random.Generator,
        heights: Sequence[float] = (),
        nearest: float = 0.0,
    ) -> Float[np.ndarray, "4 4"]:
        """Return a random camera pose (OpenCV axes) that looks at a point near an item.

        The camera steps back until the axes of all items, of the given heights, are at least ``nearest``
        metres away, since sensors are held no closer than they can measure.
        """
        azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(*self.config.elevation)
        distance = rng.uniform(*self.config.distance)
        seen = placed[int(rng.integers(len(placed)))] if placed else np.eye(4)
        target = rng.uniform(0.3, 1.0) * np.array([*seen[:2, 3], 0]) + (0, 0, rng.uniform(0, 0.08))
        away = np.array([
            np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ])  # fmt: skip
        upturned = rng.random() < self.config.upturned
        roll = rng.uniform(-np.pi, np.pi) if upturned else rng.normal(0, 0.15)
        while nearest > 0 and _closest(placed, heights, target + distance * away) < nearest:
            distance += _STEP_BACK
        return look_at(target + distance * away, target, roll)


def _closest(
    placed: Sequence[Float[np.ndarray, "4 4"]], heights: Sequence[float], eye: Float[np.ndarray, "3"]
) -> float:
    """Return the distance in [m] from a point to the nearest of the items' axes."""
    gaps = [
        np.hypot(np.hypot(*(eye[:2] - pose[:2, 3])), eye[2] - np.clip(eye[2], 0.0, height))
        for pose, height in zip(placed, heights, strict=True)
    ]
    return float(min(gaps, default=np.inf))


def item_finish(item: TableItem, rng: np.random.Generator) -> Finish:
    """Return a random finish for an object or a distractor."""
    known = item.category is not None or item.ignored
    return random_finish(rng, item.category or "", wild=0.5) if known else thing_finish(item.mesh, rng)


def _build(
    items: Sequence[TableItem], surroundings: Sequence[trimesh.Trimesh], rng: np.random.Generator
) -> MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = "table_top"
    spec.compiler.degree = False
    spec.stat.extent, spec.stat.center = 1.0, (0, 0, 0)
    spec.visual.map.znear, spec.visual.map.zfar = 0.05, 20
    spec.visual.quality.shadowsize = 1024
    spec.visual.quality.offsamples = 0  # twice as fast; a slight blur stands in for antialiasing
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=rng.uniform(0.2, 0.9, 3), rgb2=rng.uniform(0, 0.6, 3), width=128, height=128,
    )  # fmt: skip
    add_room(spec, surroundings, rng)
    world = spec.worldbody
    world.add_light(
        name="key", type=mujoco.mjtLightType.mjLIGHT_SPOT, castshadow=True, cutoff=60, exponent=1,
        ambient=(0, 0, 0),
    )  # fmt: skip
    world.add_camera(name=CAMERA)
    for index, item in enumerate(items):
        name = f"{_ITEM}{index}"
        body = world.add_body(name=name)
        _add_part(spec, body, name, item.mesh, item_finish(item, rng))
        if item.content is not None:
            _add_part(spec, body, f"content{index}", item.content, thing_finish(item.content, rng))
    return spec


def _add_part(spec: MjSpec, body: MjsBody, name: str, mesh: trimesh.Trimesh, finish: Finish) -> None:
    add_mesh(spec, name, mesh)
    add_material(spec, name, finish)
    body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0
    )
