import json
from types import SimpleNamespace

import numpy as np
import pytest

import app.task.scan as scan
from app.options import ScanOptions
from app.screen import Screen
from manipulation.viewpoints import SCAN_VIEWPOINTS
from perception.io.scan_folder import read_scan
from sim_assets.robots import panda


@pytest.fixture
def cell(still_world, monkeypatch, overhead_frame):
    """A cell whose scanner returns two images; records what the scanner received."""
    still_world._robot = panda()
    still_world.close = lambda: None
    received = SimpleNamespace(robots=[], viewpoints=[])

    class Scanner:
        def __init__(self, robot, kinematics, **settings):
            received.robots.append(robot)

        def capture(self, viewpoints, progress, on_image):
            received.viewpoints.append(tuple(viewpoints))
            for number in (1, 2):
                progress(number, 2)
                on_image(overhead_frame)
            return [overhead_frame] * 2

    monkeypatch.setattr(scan, "ViewpointScanner", Scanner)
    monkeypatch.setattr(scan, "build_world", lambda options, task: still_world)
    return received


@pytest.mark.parametrize("video", [False, True])
def test_images_are_stored_with_their_poses(cell, tmp_path, overhead_frame, video):
    report = scan.run(ScanOptions(out=tmp_path, seed=2, quiet=True, video=video), Screen(quiet=True))
    assert report.success and report.reason == "2 images" and report.metrics["n_images"] == 2
    assert json.loads((tmp_path / "report.json").read_text())["command"] == "scan"
    frames = read_scan(tmp_path / "scan").frames
    assert len(frames) == 2
    np.testing.assert_allclose(frames[0].T_world_camera, overhead_frame.T_world_camera, atol=1e-9)
    assert cell.viewpoints == [tuple(SCAN_VIEWPOINTS)]
    assert (tmp_path / "video.mp4").exists() == video


def test_the_scanner_receives_a_restricted_robot(cell, tmp_path):
    scan.run(ScanOptions(out=tmp_path, quiet=True), Screen(quiet=True))
    (robot,) = cell.robots
    assert not hasattr(robot, "config") and not hasattr(robot, "_data")
