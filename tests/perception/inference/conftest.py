"""A decoder one can write down, and a table with what it makes, seen by cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import expit

from perception.geometry import rigid, upright_rotation
from perception.inference.meshing import mesh_from_code
from perception.inference.observation import ObjectObservation, pixel_rays
from perception.rendering.pose import ObjectPose, canonical_from_camera
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame

CAMERA = CameraIntrinsics(width=320, height=240, fx=290.0, fy=290.0, cx=159.5, cy=119.5)


class CupDecoder:
    """Solid cylinders, mugs with a knob on the +x side; codes 0, 1, 2: radius, height, knob."""

    def __init__(self) -> None:
        line = np.linspace(-31 / 32, 31 / 32, 32)
        self._points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)

    @staticmethod
    def distance(points: np.ndarray, code: np.ndarray, knob: bool) -> np.ndarray:
        """Signed distance to the surface in canonical units, a lower bound of it outside."""
        x, y, z = np.moveaxis(points, -1, 0)
        radius, height, reach = 0.55 + 0.08 * code[0], 0.75 + 0.08 * code[1], 0.22 + 0.04 * code[2]
        body = np.maximum(np.sqrt(x**2 + y**2 + 1e-6) - radius, np.abs(z) - height)
        side = np.sqrt((x - radius) ** 2 + y**2 + z**2 + 1e-6) - reach
        return np.minimum(body, side) if knob else body

    def _grid(self, code: np.ndarray, knob: bool) -> np.ndarray:
        return expit(-64 * self.distance(self._points, code, knob))

    def __call__(self, category: str, code: np.ndarray) -> np.ndarray:
        return self._grid(code, category == "mug").astype(np.float32)

    def with_jacobian(
        self, category: str, code: np.ndarray, threads: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        knob, jacobian = category == "mug", np.zeros((32, 32, 32, 16), np.float32)
        for k in range(3):
            step = 1e-5 * np.eye(16)[k]
            jacobian[..., k] = (self._grid(code + step, knob) - self._grid(code - step, knob)) / 2e-5
        return self(category, code), jacobian


@dataclass(frozen=True)
class Table:
    """One object on the plane z = 0 and the frames that see it."""

    decoder: CupDecoder
    category: str
    code: np.ndarray
    pose: ObjectPose

    def camera(self, azimuth: float, elevation: float = 0.7, distance: float = 0.5) -> np.ndarray:
        """Pose of a camera that looks at the object."""
        ahead = -np.array(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(azimuth) * np.cos(elevation),
                np.sin(elevation),
            ]
        )
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        return rigid(rotation, self.pose.translation - distance * ahead)

    def frame(
        self, T_world_camera: np.ndarray, rng: np.random.Generator, present: bool = True
    ) -> tuple[RgbdFrame, np.ndarray]:
        """Depth with 1 mm noise, and the object's mask."""
        u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
        blank = np.zeros((CAMERA.height, CAMERA.width), np.float32)
        rgb = np.zeros((*blank.shape, 3), np.uint8)
        rays = pixel_rays(RgbdFrame(0.0, rgb, blank, CAMERA), u, v)
        down = (rays @ T_world_camera[:3, :3].T)[..., 2]
        table = np.where(down < -1e-3, -T_world_camera[2, 3] / np.minimum(down, -1e-3), 0.0)
        mask = np.zeros(blank.shape, bool)
        depth = np.where(table < 3.0, table, 0.0)
        if present:
            hit = self._trace(rays.reshape(-1, 3), T_world_camera).reshape(blank.shape)
            mask = hit > 0
            depth = np.where(mask, hit, depth)
        noisy = np.where(depth > 0, depth + rng.normal(0, 0.001, depth.shape), 0).clip(0)
        return RgbdFrame(0.0, rgb, noisy.astype(np.float32), CAMERA, T_world_camera), mask

    def _trace(self, rays: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
        """Depth of the true surface along rays by sphere tracing, 0 where they miss."""
        A = canonical_from_camera(self.pose, T_world_camera[None])[0]
        directions = rays @ A[:, :3].T
        speed, depth = np.linalg.norm(directions, axis=-1), np.full(len(rays), 0.2)
        for _ in range(60):
            points = depth[:, None] * directions + A[:, 3]
            gap = self.decoder.distance(points, self.code, self.category == "mug")
            depth = depth + gap / speed
        return np.where((gap < 1e-3) & (depth < 2.0), depth, 0.0)

    def observations(self, azimuths: tuple[float, ...], seed: int = 0) -> list[ObjectObservation]:
        rng = np.random.default_rng(seed)
        seen = [self.frame(self.camera(azimuth), rng) for azimuth in azimuths]
        return [ObjectObservation(frame, mask) for frame, mask in seen]


@pytest.fixture(scope="session")
def decoder() -> CupDecoder:
    return CupDecoder()


@pytest.fixture(scope="session")
def make_table(decoder: CupDecoder) -> Callable[..., Table]:
    """Puts an object with the first codes given on the table."""

    def make(category: str, codes: tuple[float, ...], yaw: float, scale: float = 0.05) -> Table:
        code = np.zeros(16)
        code[: len(codes)] = codes
        height = scale * (0.75 + 0.08 * code[1])
        rotation = upright_rotation(np.array([0.0, 0.0, 1.0]), yaw)
        pose = ObjectPose(rotation, np.array([0.4, -0.1, height]), np.full(3, scale))
        return Table(decoder, category, code, pose)

    return make


@pytest.fixture(scope="session")
def can(make_table):
    return make_table("can", (1.5, -1.0), yaw=0.0)


@dataclass(frozen=True)
class Stack:
    """A can on a narrower one, seen from three sides: the masks of both together, and of the upper one."""

    lower: Table
    higher: Table
    seen: list[ObjectObservation]
    upper: list[np.ndarray]
    height: float


@pytest.fixture(scope="session")
def stack(make_table) -> Stack:
    lower, higher = make_table("can", (0.0, 0.0), yaw=0.0), make_table("can", (1.5, -1.0), yaw=0.0)
    top = 2 * float(lower.pose.translation[2])
    higher = replace(
        higher, pose=replace(higher.pose, translation=np.add(higher.pose.translation, (0.0, 0.0, top)))
    )
    rng, seen, upper = np.random.default_rng(0), [], []
    for azimuth in (0.0, 2.1, 4.2):
        T = lower.camera(azimuth, elevation=0.4)
        (below, mask_below), (above, mask_above) = lower.frame(T, rng), higher.frame(T, rng)
        first = mask_above & (~mask_below | (above.depth < below.depth))
        frame = replace(below, depth=np.where(first, above.depth, below.depth))
        seen.append(ObjectObservation(frame, mask_below | mask_above))
        upper.append(first)
    return Stack(lower, higher, seen, upper, top)


@pytest.fixture(scope="module")
def mug(make_table) -> Table:
    """An upright mug on a table."""
    return make_table("mug", (0.0, 0.0, 1.0), yaw=0.8)


@pytest.fixture(scope="module")
def estimate(mug) -> ObjectEstimate:
    """The mug as it is."""
    mesh = mesh_from_code(mug.decoder, mug.category, mug.code, mug.pose.scale)
    return ObjectEstimate(0, "mug", mug.code, mug.pose.T_world_object, mug.pose.scale, mesh)
