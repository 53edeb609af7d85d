"""One object alone on a table, seen from random places: what reconstruction is judged on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from perception.types import RgbdFrame
from sim_assets.cell.layout import PlanarPose
from sim_assets.datasets.scatter import make_thing, simplified
from sim_assets.datasets.table_top import TableTop, TrainingSceneConfig
from sim_assets.objects import ObjectModel
from sim_assets.rendering.camera import look_at
from sim_assets.rendering.depth_noise import DepthNoise


@dataclass(frozen=True)
class PortraitConfig:
    """How the views vary.

    Attributes:
        width, height: in pixels.
        fovy: vertical field of view in [deg].
        distance: of the camera from the object's middle in [m], for an object 0.1 m long; farther away for
            longer ones, so that all of it is in the image.
        elevation: of the camera in [rad].
        off_centre: deviation of the point the camera looks at from the object's middle in [m].
        depth_noise: of the camera.
    """

    width: int = 640
    height: int = 480
    fovy: float = 45.0
    distance: tuple[float, float] = (0.4, 0.7)
    elevation: tuple[float, float] = (np.radians(25), np.radians(70))
    off_centre: float = 0.015
    depth_noise: DepthNoise = "gaussian"


@dataclass(frozen=True)
class Portrait:
    """Frames of one object, and where it stood.

    Attributes:
        frames: with the cameras' poses; the table is the plane z = 0.
        T_world_object: (4, 4) pose, origin at the centre of its base, mug handle along +x.
    """

    frames: tuple[RgbdFrame, ...]
    T_world_object: Float[np.ndarray, "4 4"]


def take_portrait(
    model: ObjectModel, views: int, rng: np.random.Generator, config: PortraitConfig | None = None
) -> Portrait:
    """Puts the object somewhere near the origin, turned at random, and looks at it from random places."""
    config = config or PortraitConfig()
    thing = make_thing(model.category, simplified(model.mesh))
    scene = replace(TrainingSceneConfig(), width=config.width, height=config.height, textures_redrawn=1)
    table = TableTop([thing], scene, rng)
    try:
        table.redraw_textures(rng)
        x, y = rng.uniform(-0.1, 0.1, 2)
        pose = PlanarPose(x, y, rng.uniform(-np.pi, np.pi))
        table.show([0], [pose])
        table.light(rng)
        longest = float(model.mesh.extents.max())
        frames = []
        for _ in range(views):
            T_world_camera = _random_camera(pose, model.height, longest, config, rng)
            frames.append(table.capture(T_world_camera, config.fovy, False, rng, config.depth_noise)[0])
    finally:
        table.close()
    return Portrait(tuple(frames), pose.matrix)


def _random_camera(
    pose: PlanarPose, height: float, longest: float, config: PortraitConfig, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"]:
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(*config.elevation)
    distance = rng.uniform(*config.distance) * max(longest / 0.1, 1.0) ** 0.5
    away = np.array([
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    ])  # fmt: skip
    target = np.array([pose.x, pose.y, height / 2]) + rng.normal(0, config.off_centre, 3)
    return look_at(target + distance * away, target)
