"""Frustums of the images."""

from dataclasses import replace

import numpy as np
import pytest

from app.runs.replay import Recorder
from app.viewer.camera_layer import FRUSTUM_COLOR, LATEST_COLOR, CameraLayer
from app.viewer.display import DisplayOptions
from app.viewer.snapshot import Snapshot


@pytest.fixture
def draw(server, make_frame):
    """Draw a snapshot of three images, of which the second one has no pose."""
    frames = [make_frame(x) for x in (0.1, 0.2, 0.3)]
    frames[1] = replace(frames[1], T_world_camera=None)
    layer = CameraLayer(server, Recorder(frames=frames))
    return lambda options=None, **values: layer.draw(Snapshot(**values), options or DisplayOptions())


def test_a_frustum_is_at_the_pose_of_its_image_with_its_field_of_view(draw, node):
    draw(n_frames=3)
    assert node("/cameras/1") is None
    for index, x in ((0, 0.1), (2, 0.3)):
        np.testing.assert_allclose(node(f"/cameras/{index}").position, (x, -0.2, 0.5))
    assert node("/cameras/0").fov == pytest.approx(2 * np.arctan(24 / 50))
    assert node("/cameras/0").aspect == pytest.approx(64 / 48)


def test_the_latest_image_is_highlighted(draw, node):
    colors = lambda: [tuple(int(v) for v in node(f"/cameras/{i}").color) for i in (0, 2)]  # noqa: E731
    draw(n_frames=3, stage="scan")
    assert colors() == [FRUSTUM_COLOR, LATEST_COLOR]
    draw(n_frames=3, n_searched=1, stage="detect")
    assert colors() == [LATEST_COLOR, FRUSTUM_COLOR]


def test_images_are_drawn_once_and_again_with_their_detections(draw, node):
    draw(n_frames=3)
    first, last = node("/cameras/0"), node("/cameras/2")
    draw(n_frames=3, n_searched=1)
    assert node("/cameras/0") is not first and node("/cameras/2") is last


def test_seeking_backwards_removes_later_images(draw, node):
    draw(n_frames=3)
    draw(n_frames=1)
    assert node("/cameras/2") is None and node("/cameras/0") is not None
    draw(n_frames=3)
    assert node("/cameras/2") is not None


def test_cameras_are_hidden_during_execution_and_on_request(draw, node):
    for stage, options, visible in (
        ("plan", DisplayOptions(), True),
        ("execute", DisplayOptions(), False),
        ("plan", DisplayOptions(cameras=False), False),
    ):
        draw(options, n_frames=1, stage=stage)
        assert node("/cameras/0").visible == visible
