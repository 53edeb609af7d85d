"""Scene, panel and player together."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.runs.replay import Recorder
from app.viewer.panel import FOLLOW, THROUGH_CAMERA
from app.viewer.snapshot import ObjectOutcome, Snapshot
from app.viewer.surroundings import CELL_POSITION, CELL_TARGET, surroundings_of
from app.viewer.viewer import PANEL_INTERVAL, TARGET_DISTANCE, Viewer, set_initial_view


@pytest.fixture
def viewer(server, recording):
    return Viewer(server, recording)


def at(x, bodies=3):
    return Snapshot(poses=np.array([[x, 0, 0.1, 0, 1, 0, 0]] * bodies, dtype=np.float64))


def test_the_initial_view_is_that_of_the_surroundings(server, recording):
    set_initial_view(server, surroundings_of(recording))
    np.testing.assert_allclose(server.initial_camera.position, CELL_POSITION)
    np.testing.assert_allclose(server.initial_camera.look_at, CELL_TARGET)


def test_a_replay_starts_with_the_first_client_and_a_live_view_at_once(viewer, server, recording):
    assert not viewer.player.playing and Viewer(server, recording, live=True).player.playing
    viewer._on_connect(None)
    assert viewer.player.playing
    viewer.player.pause()
    viewer._on_connect(None)
    assert not viewer.player.playing


def test_the_panel_is_drawn_less_often_than_the_scene(viewer, node, monkeypatch):
    drawn = []
    monkeypatch.setattr(viewer.panel, "draw", lambda snapshot: drawn.append(snapshot.time))
    viewer.player.time = viewer.player.timeline.end
    for _ in range(2 * PANEL_INTERVAL):
        viewer._draw()
    assert drawn == [viewer.player.timeline.end] * 2
    np.testing.assert_allclose(node("/objects/0").position, (0.4, 0.2, 0.05), atol=1e-9)


def test_another_recording_replaces_the_scene(viewer, node):
    viewer._draw()
    assert node("/cell/hand") is not None
    viewer.show(Recorder(), live=True)
    viewer._draw()
    assert node("/cell/hand") is None and viewer.player.live


def test_the_title_sets_the_outcomes(viewer):
    outcomes = {0: ObjectOutcome(True, 0.004)}
    viewer.set_title("Pack", "1 of 1", outcomes)
    assert "Pack" in viewer.panel._header.content and viewer.panel._outcomes is outcomes
    viewer.set_title("Sort", "")
    assert not viewer.panel._outcomes


def test_the_view_moves_with_the_gripper_or_through_the_camera(viewer, server, monkeypatch):
    camera = SimpleNamespace(position=np.array([1.0, 0, 1]), look_at=np.zeros(3), up_direction=np.ones(3))
    client = SimpleNamespace(camera=camera, atomic=server.atomic)
    monkeypatch.setattr(server, "get_clients", lambda: {0: client})
    viewer.panel._view.value = FOLLOW
    viewer._move_views(at(0.1))
    np.testing.assert_allclose(camera.position, (1, 0, 1))
    viewer._move_views(at(0.3))
    np.testing.assert_allclose(camera.position, (1.2, 0, 1))
    np.testing.assert_allclose(camera.look_at, (0.2, 0, 0))
    viewer.panel._view.value = "free"
    viewer._move_views(at(0.9))
    np.testing.assert_allclose(camera.position, (1.2, 0, 1))
    viewer.panel._view.value = THROUGH_CAMERA
    viewer._move_views(at(0.5))
    np.testing.assert_allclose(camera.position, (0.5, 0, 0.1))
    np.testing.assert_allclose(camera.look_at, (0.5, 0, 0.1 - TARGET_DISTANCE), atol=1e-12)
    np.testing.assert_allclose(camera.up_direction, (0, 1, 0), atol=1e-12)
