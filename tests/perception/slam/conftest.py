"""Cylinders on a plane as a world to track in: a decoder one can write down, exact images, true landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from perception.inference.problem import FitState
from perception.inference.shape_model import linearise
from perception.rendering.pose import ObjectPose
from perception.slam.landmarks import Landmark, LandmarkMap, reach_of
from perception.types import ObjectDetection, RgbdFrame, SupportPlane

RADIUS, HALF = 0.55, 0.75  # of the decoder's cylinder at code 0, in canonical units


class CylinderDecoder:
    """Solid cylinders; codes 0 and 1 change radius and height."""

    def __init__(self) -> None:
        line = torch.linspace(-31 / 32, 31 / 32, 32, dtype=torch.float64)
        self._points = torch.meshgrid(line, line, line, indexing="ij")

    def _grid(self, code: Tensor) -> Tensor:
        x, y, z = self._points
        side = torch.sqrt(x**2 + y**2) - (RADIUS + 0.08 * code[0])
        return torch.sigmoid(-64 * torch.maximum(side, z.abs() - (HALF + 0.08 * code[1])))

    def __call__(self, category: str, codes: Tensor) -> Tensor:
        return torch.stack([self._grid(code).float() for code in codes])

    def with_jacobian(self, category: str, code: Tensor, threads: int = 1) -> tuple[Tensor, Tensor]:
        code = code.double()
        jacobian = torch.zeros((32, 32, 32, 16))
        for k in range(2):
            step = torch.zeros(16, dtype=torch.float64)
            step[k] = 1e-5
            jacobian[..., k] = (self._grid(code + step) - self._grid(code - step)) / 2e-5
        return self._grid(code).float(), jacobian


@dataclass(frozen=True)
class World:
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
            number, "can", state, shape, reach_of(shape, state), 0.5, np.log([0.1, 0.1, 0.1, 0.7])
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
def cylinders(scenes) -> World:
    """Five cylinders of different sizes."""
    places = (
        (0.0, 0.0, 0.03),
        (0.16, 0.05, 0.036),
        (-0.14, 0.08, 0.028),
        (0.05, 0.19, 0.04),
        (-0.1, -0.13, 0.033),
    )
    return World(CylinderDecoder(), scenes, places)
