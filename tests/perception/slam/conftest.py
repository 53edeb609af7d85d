"""Labelled frames of the world of cylinders."""

from __future__ import annotations

import numpy as np
import pytest

from perception.slam.labelled_frame import LabelledFrame


@pytest.fixture(scope="session")
def observe(cylinders):
    """Return a function that renders a labelled frame whose masks are associated with their landmarks."""

    def labelled(T_world_camera: np.ndarray, number: int = 0, noise: float = 0.001, world=cylinders):
        frame, detections, ids = world.look(T_world_camera, noise)
        view = LabelledFrame.of(number, frame, detections)
        return view.associated({label: id for label, id in enumerate(ids, start=1)})

    return labelled


@pytest.fixture(scope="session")
def T_view(scenes) -> np.ndarray:
    """Pose of a camera that sees all cylinders."""
    return scenes.orbit((0, 0.03, 0.03), 0.55, 45, 20)
