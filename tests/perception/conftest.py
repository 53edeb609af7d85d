"""Scenes with known answers: solids on a plane rendered in closed form, and a decoder of cylinders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import expit

from perception.inference.problem import FitState
from perception.inference.shape_model import linearise
from perception.rendering.pose import ObjectPose
from perception.slam.landmarks import Landmark, LandmarkMap, bounding_radius
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

RADIUS, HALF = 0.55, 0.75  # of the decoder's cylinder at code 0, in canonical units


@dataclass(frozen=True)
class Solid:
    """An upright box (half sizes x, y) or, with ``radius``, a cylinder, of a height above its bottom."""

    x: float
    y: float
    height: float
    radius: float = 0.0
    half: tuple[float, float] = (0.0, 0.0)
    bottom: float = 0.0

    def first_hit(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Ray parameter (H, W) where each ray enters the solid, inf where it misses."""
        o = origin - (self.x, self.y, self.bottom)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.sort(np.stack([-o[2] / rays[..., 2], (self.height - o[2]) / rays[..., 2]]), axis=0)
            enter, leave = z[0], z[1]
            if self.radius:
                a = (rays[..., :2] ** 2).sum(-1)
                b = rays[..., :2] @ o[:2]
                root = np.sqrt(b**2 - a * (o[:2] @ o[:2] - self.radius**2))
                enter = np.fmax(enter, (-b - root) / a)
                leave = np.where(np.isnan(root), -np.inf, np.fmin(leave, (-b + root) / a))
            else:
                for axis in (0, 1):
                    sides = np.stack([(s * self.half[axis] - o[axis]) / rays[..., axis] for s in (-1, 1)])
                    sides = np.sort(sides, axis=0)
                    enter, leave = np.fmax(enter, sides[0]), np.fmin(leave, sides[1])
        return np.where((enter < leave) & (enter > 0), enter, np.inf)


@dataclass(frozen=True)
class Scene:
    frame: RgbdFrame
    instances: np.ndarray  # (H, W) int: index of the solid, -1 the table


def look_at(eye: Sequence[float], target: Sequence[float]) -> np.ndarray:
    """T_world_camera of an upright camera at ``eye`` that looks at ``target``."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    seed = (0.0, 0.0, 1.0) if abs(forward[2]) < 0.999 else (0.0, 1.0, 0.0)
    right = np.cross(forward, seed)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T


def orbit(target: Sequence[float], distance: float, elevation: float, azimuth: float) -> np.ndarray:
    """T_world_camera on a sphere about the target; angles in degrees."""
    e, a = np.radians((elevation, azimuth))
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return look_at(np.asarray(target) + distance * direction, target)


def render(
    solids: Sequence[Solid],
    T_world_camera: np.ndarray,
    noise: float = 0.0,
    size: tuple[int, int] = (320, 240),
) -> Scene:
    """Exact depth of the solids on the plane z = 0, with Gaussian noise [m] on top; solids grey by number."""
    width, height = size
    k = CameraIntrinsics(width, height, 0.905 * width, 0.905 * width, (width - 1) / 2, (height - 1) / 2)
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], -1) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        table = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], np.inf)
    hits = np.stack([table] + [solid.first_hit(origin, rays) for solid in solids])
    nearest = hits.argmin(0)
    depth = hits.min(0)
    depth = np.where(
        np.isfinite(depth), depth + np.random.default_rng(0).normal(0, 1, depth.shape) * noise, 0
    )
    rgb = np.repeat((40 + 20 * nearest)[..., None], 3, axis=-1).astype(np.uint8)
    frame = RgbdFrame(0.0, rgb, depth.clip(0).astype(np.float32), k, T_world_camera)
    return Scene(frame, nearest - 1)


@pytest.fixture(scope="session")
def scenes():
    """The tools of this module, as a namespace."""
    return SimpleNamespace(Solid=Solid, render=render, orbit=orbit, look_at=look_at)


class CylinderDecoder:
    """Solid cylinders; codes 0 and 1 change radius and height."""

    def __init__(self) -> None:
        line = np.linspace(-31 / 32, 31 / 32, 32)
        self._points = np.meshgrid(line, line, line, indexing="ij")

    def _grid(self, code: np.ndarray) -> np.ndarray:
        x, y, z = self._points
        side = np.sqrt(x**2 + y**2) - (RADIUS + 0.08 * code[0])
        return expit(-64 * np.maximum(side, np.abs(z) - (HALF + 0.08 * code[1])))

    def __call__(self, category: str, code: np.ndarray) -> np.ndarray:
        return self._grid(code).astype(np.float32)

    def with_jacobian(
        self, category: str, code: np.ndarray, threads: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        jacobian = np.zeros((32, 32, 32, 16), np.float32)
        for k in range(2):
            step = 1e-5 * np.eye(16)[k]
            jacobian[..., k] = (self._grid(code + step) - self._grid(code - step)) / 2e-5
        return self(category, code), jacobian


@dataclass(frozen=True)
class CylinderWorld:
    """True cylinders: (x, y, radius) each, as high as the decoder's."""

    decoder: CylinderDecoder
    scenes: object
    places: tuple[tuple[float, float, float], ...]

    @property
    def plane(self) -> SupportPlane:
        return SupportPlane()

    def landmark(self, number: int) -> Landmark:
        x, y, radius = self.places[number]
        scale = radius / RADIUS
        pose = ObjectPose(np.eye(3), np.array([x, y, HALF * scale]), np.full(3, scale))
        state = FitState(pose, np.zeros(16))
        shape = linearise(self.decoder, "can", state.code)
        return Landmark(
            number, "can", state, shape, bounding_radius(shape, state), 0.5, np.log([0.1, 0.1, 0.1, 0.7])
        )

    def map(self) -> LandmarkMap:
        return LandmarkMap(self.plane).with_landmarks(*(self.landmark(k) for k in range(len(self.places))))

    def look(
        self, T_world_camera: np.ndarray, noise: float = 0.001
    ) -> tuple[RgbdFrame, list[ObjectDetection], list[int]]:
        """An image, its masks, and the number of the cylinder that each shows."""
        solids = [self.scenes.Solid(x, y, 2 * HALF * r / RADIUS, radius=r) for x, y, r in self.places]
        scene = self.scenes.render(solids, T_world_camera, noise)
        shown = [k for k in range(len(solids)) if (scene.instances == k).sum() > 60]
        return scene.frame, [ObjectDetection("can", 0.9, scene.instances == k) for k in shown], shown


@pytest.fixture(scope="session")
def cylinders(scenes) -> CylinderWorld:
    """Five cylinders of different sizes."""
    places = (
        (0.0, 0.0, 0.03),
        (0.16, 0.05, 0.036),
        (-0.14, 0.08, 0.028),
        (0.05, 0.19, 0.04),
        (-0.1, -0.13, 0.033),
    )
    return CylinderWorld(CylinderDecoder(), scenes, places)
