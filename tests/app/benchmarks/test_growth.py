"""Growth curves with jobs that take no time."""

import json

import numpy as np
import pytest

from app.benchmarks import growth
from app.benchmarks.growth import Curve, Point
from app.benchmarks.growth_planning import PlanningTimes
from app.cli import run
from app.options import BenchOptions
from app.screen import Screen
from perception.detection.detector import Detector
from perception.pipeline import Perception
from perception.shape.decoder import ShapeDecoder
from perception.slam.frame_result import FrameResult


@pytest.fixture(scope="module")
def networks():
    return Perception(Detector.load(), ShapeDecoder.load())


@pytest.fixture
def two_curves(monkeypatch):
    """Replace the measurements by two curves."""
    curves = [
        Curve("fit", "objects", (Point(1, 0.2, 0.1), Point(10, 2.0, 1.0))),
        Curve("episode", "workers", (Point(1, 8.0, None), Point(2, 4.0, None))),
    ]
    monkeypatch.setattr(growth, "load_perception", lambda device: None)
    monkeypatch.setattr(growth, "_curves", lambda networks, options: iter(curves))
    return curves


def test_report_and_plot_have_every_curve(two_curves, tmp_path):
    report = growth.run(BenchOptions(growth=True, out=tmp_path, quiet=True), Screen(quiet=True))
    stored = json.loads((tmp_path / "report.json").read_text())
    assert report.success and stored["success"] and stored["reason"] == "2 curves"
    assert [curve["name"] for curve in stored["metrics"]["curves"]] == ["fit", "episode"]
    assert stored["metrics"]["curves"][0]["points"][1] == {"at": 10, "seconds": 2.0, "core_seconds": 1.0}
    assert b"objects" in (tmp_path / "growth.svg").read_bytes()


def test_the_option_selects_the_curves(two_curves, tmp_path, capsys):
    assert run(["bench", "--growth", "--out", str(tmp_path / "a")]) == 0
    assert "episode" in capsys.readouterr().out


def test_a_point_is_the_median(monkeypatch):
    times = iter([(3.0, 1.0), (1.0, 3.0), (2.0, 9.0)])
    monkeypatch.setattr(growth, "clocked", lambda job: next(times))
    assert growth._point(5, 3, lambda: None) == Point(5, 2.0, 3.0)


def test_planning_is_a_curve_of_layouts_and_two_of_objects(networks, monkeypatch):
    times = {n: PlanningTimes(float(n), (0.2, 0.3, n / 2)) for n in growth.PACKED}
    monkeypatch.setattr(growth, "planning_times", lambda networks, n, seed: times[n])
    layout, one, slowest = growth._over_packed(networks, 0)
    assert [point.at for point in layout.points] == [2, 4, 6, 8, 10, 12]
    assert layout.points[0] == Point(2, None, 2.0)
    assert one.points[5] == Point(12, None, 0.3) and slowest.points[5] == Point(12, None, 6.0)


def test_stages_of_slam_are_curves(networks, monkeypatch):
    """A map in which a stage did not run has no point."""
    times = {1: {}, 3: {"track": [0.1]}, 10: {"track": [0.3, 0.1, 0.2], "joint": [2.0]}, 30: {}, 100: {}}
    monkeypatch.setattr(growth, "_stage_times", lambda networks, n, seed: times[n])
    tracked, joint = growth._over_landmarks(networks, 0)
    assert tracked.points == (Point(3, None, 0.1), Point(10, None, 0.2))
    assert joint.points == (Point(10, None, 2.0),)


def test_times_of_the_first_two_and_of_lost_frames_do_not_count(networks, monkeypatch):
    statuses = ["tracked", "tracked", "lost", "weak", "tracked"]
    results = iter(
        FrameResult(k, k / 30, np.eye(4), status, seconds={"track": float(k)})
        for k, status in enumerate(statuses)
    )
    monkeypatch.setattr(growth, "sequence", lambda *_: list(range(len(statuses))))
    monkeypatch.setattr(growth.Slam, "process", lambda self, frame: next(results))
    assert growth._stage_times(networks, 3, 0) == {"track": [3.0, 4.0]}


def test_episodes_are_spread_over_the_workers(monkeypatch):
    asked = []

    def finish(jobs, options):
        asked.append((options.workers, list(jobs.items)))
        return iter(())

    monkeypatch.setattr(growth, "run_jobs", finish)
    curve = growth._over_workers(BenchOptions(seed=7, growth_workers=(1, 3)))
    assert asked == [(1, [7, 8, 9, 10]), (3, [7, 8, 9, 10])]
    assert [point.at for point in curve.points] == [1, 3] and curve.points[0].core_seconds is None
