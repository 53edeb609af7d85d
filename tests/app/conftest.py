"""Object estimates without noise, and an image to draw them into."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import trimesh

from perception.types import CameraIntrinsics, Category, ObjectEstimate, RgbdFrame, TriangleMesh


@pytest.fixture(autouse=True)
def closed_run_folders() -> Iterator[None]:
    """Unlock the run folders that a test leaves open."""
    yield
    if "app.runs.run_folder" in sys.modules:
        sys.modules["app.runs.run_folder"].finish_all(complete=True)


@pytest.fixture
def standing(decoded: Callable[[Category], TriangleMesh]) -> Callable[..., ObjectEstimate]:
    """The decoded object of a class as an estimate that stands on z = 0 at (x, y)."""

    def estimate(category: Category, number: int = 0, at: tuple[float, float] = (0.0, 0.0)) -> ObjectEstimate:
        mesh = decoded(category)
        T = np.eye(4)
        T[:3, 3] = (*at, -mesh.vertices[:, 2].min())
        return ObjectEstimate(number, category, np.zeros(16), T, np.full(3, 0.1), mesh)

    return estimate


@pytest.fixture
def overhead_frame() -> RgbdFrame:
    """A grey image from 0.55 m above (0.4, -0.2), image x along world x."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (0.4, -0.2, 0.55)
    rgb, depth = np.full((120, 160, 3), 100, np.uint8), np.full((120, 160), 0.55, np.float32)
    return RgbdFrame(0.0, rgb, depth, CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5), T)


@pytest.fixture
def can_at() -> Callable[..., ObjectEstimate]:
    """Cylinders of radius 35 mm and height 0.1 m that stand at (x, y)."""

    def estimate(id: int = 0, x: float = 0.4, y: float = -0.2) -> ObjectEstimate:
        mesh = trimesh.creation.cylinder(radius=0.035, height=0.1, sections=24)
        T = np.eye(4)
        T[:3, 3] = (x, y, 0.05)
        return ObjectEstimate(
            id, "can", np.zeros(16), T, np.full(3, 0.055), TriangleMesh(mesh.vertices, mesh.faces)
        )

    return estimate
