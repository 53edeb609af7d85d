"""Views of a single object on a table from random viewpoints, for the evaluation of reconstruction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from perception.types import RgbdFrame
from sim_assets.cell.layout import PlanarPose
from sim_assets.datasets.scatter import make_item, simplified
from sim_assets.datasets.scene_config import TrainingSceneConfig
from sim_assets.datasets.table_top import TableTop
from sim_assets.objects import ObjectModel
from sim_assets.rendering.camera import look_at
from sim_assets.rendering.depth_noise import DepthNoise


@dataclass(frozen=True)
class SingleObjectConfig:
    """Distributions that views of a single object are sampled from.

    Attributes:
        width, height: size of the images in pixels.
        fovy: vertical field of view in [deg].
        distance: range of the camera's distance from the object's centre in [m], for an object 0.1 m long;
            scaled by the square root of the length for longer ones, so that they fit into the image.
        elevation: range of the camera's elevation in [rad].
        off_centre: standard deviation of the camera's target from the object's centre in [m].
        depth_noise: model of the depth noise.
    """

    width: int = 640
    height: int = 480
    fovy: float = 45.0
    distance: tuple[float, float] = (0.4, 0.7)
    elevation: tuple[float, float] = (np.radians(25), np.radians(70))
    off_centre: float = 0.015
    depth_noise: DepthNoise = "gaussian"


@dataclass(frozen=True)
class SingleObjectViews:
    """RGB-D frames of one object and its true pose.

    Attributes:
        frames: RGB-D frames with camera poses; the table is the plane z = 0.
        masks: true mask of the object in each frame.
        T_world_object: (4, 4) pose, origin at the centre of its base, mug handle along +x.
    """

    frames: tuple[RgbdFrame, ...]
    masks: tuple[Bool[np.ndarray, "h w"], ...]
    T_world_object: Float[np.ndarray, "4 4"]


def render_single_object(
    model: ObjectModel,
    views: int,
    rng: np.random.Generator,
    config: SingleObjectConfig | None = None,
    T_rest: Float[np.ndarray, "4 4"] | None = None,
) -> SingleObjectViews:
    """Place the object near the origin at a random yaw and render it from random viewpoints.

    Args:
        model: the object.
        views: number of images.
        rng: source of randomness.
        config: distributions of cameras and noise.
        T_rest: pose of the object at rest on the plane z = 0, before the yaw; upright if None.
    """
    config = config or SingleObjectConfig()
    rest = np.eye(4) if T_rest is None else T_rest
    mesh = simplified(model.mesh)
    item = make_item(model.category, mesh if T_rest is None else mesh.apply_transform(rest))
    scene = replace(TrainingSceneConfig(), width=config.width, height=config.height, textures_redrawn=1)
    table = TableTop([item], scene, rng)
    try:
        table.redraw_textures(rng)
        x, y = rng.uniform(-0.1, 0.1, 2)
        pose = PlanarPose(x, y, rng.uniform(-np.pi, np.pi))
        table.show([0], [pose.matrix])
        table.light(rng)
        longest = float(model.mesh.extents.max())
        height = model.height if T_rest is None else float(item.mesh.bounds[1, 2])
        frames, masks = [], []
        for _ in range(views):
            T_world_camera = _random_camera(pose, height, longest, config, rng)
            true, items = table.capture(T_world_camera, config.fovy, False)
            frames.append(table.sense(true, config.depth_noise, rng))
            masks.append(items == 0)
    finally:
        table.close()
    return SingleObjectViews(tuple(frames), tuple(masks), pose.matrix @ rest)


def _random_camera(
    pose: PlanarPose, height: float, longest: float, config: SingleObjectConfig, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(*config.elevation)
    distance = rng.uniform(*config.distance) * max(longest / 0.1, 1.0) ** 0.5
    away = np.array([
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    ])  # fmt: skip
    target = np.array([pose.x, pose.y, height / 2]) + rng.normal(0, config.off_centre, 3)
    return look_at(target + distance * away, target)
