"""Episodes in the simulated cell: what the pipeline receives, and how its results are reported."""

import inspect
from dataclasses import replace

import numpy as np
import pytest

import app.task.episode as episode
from app.options import PackOptions, SortOptions
from app.runs.report import ObjectReport
from app.task.cell import build_world
from app.task.episode import (
    reconstruction_of,
    request_of,
    run_episode,
    settings_of,
    summary_of,
    with_check,
)
from app.task.run import task_of
from app.task.run_observer import RunObserver
from app.task.scoring import read_truth
from app.task.task_types import TaskResult
from manipulation.robot import DepthCamera, HandInMotion, Robot
from perception.inference.refit import PoseCheck
from perception.pipeline import Perception, load_perception
from sim_assets.cell import ground_truth

PROTOCOL = {
    name for part in (Robot, DepthCamera, HandInMotion) for name in vars(part) if not name.startswith("_")
}


class TruthRead(AssertionError):
    """Ground truth was read while the pipeline ran."""


@pytest.fixture
def guarded_pipeline(monkeypatch):
    """Lets the pipeline run with every function of ground truth raising; records the robots it received."""
    robots, run_pipeline = [], episode.run_pipeline

    def forbidden(*args, **kwargs):
        raise TruthRead

    def run_guarded(robot, *args):
        robots.append(robot)
        with pytest.MonkeyPatch.context() as patch:
            for name, _ in inspect.getmembers(ground_truth, inspect.isfunction):
                patch.setattr(ground_truth, name, forbidden)
            with pytest.raises(TruthRead):
                ground_truth.object_poses(None)
            return run_pipeline(robot, *args)

    monkeypatch.setattr(episode, "run_pipeline", run_guarded)
    return robots


@pytest.mark.parametrize("kind", [PackOptions, SortOptions])
def test_a_whole_episode_without_ground_truth_behind_the_protocol(kind, guarded_pipeline):
    options = kind(objects="can=1,bowl=1", seed=3, device="cpu", quiet=True)
    with build_world(options, task_of(options)) as world:
        report, result = run_episode(world, options, task_of(options), load_perception("cpu"))
        (robot,) = guarded_pipeline
        assert {name for name in dir(robot) if not name.startswith("_")} == PROTOCOL
        for name in ("config", "_data", "_model", "_renderer", "overview_image", "wait", "observe", "time"):
            assert hasattr(world, name) and not hasattr(robot, name)
    assert report.success, report.reason
    assert report.reason == "2 of 2 objects in place"
    assert report.metrics["n_perceived"] == 2 and report.metrics["simulated_seconds"] > 10
    assert all(entry.details["seen_in_place"] for entry in report.objects)
    assert report.timings["total"] >= sum(result.timings.values())


@pytest.fixture(scope="module")
def cell():
    with build_world(PackOptions(objects="can=1", seed=1), "pack") as world:
        yield world


def test_the_total_time_excludes_pauses(cell, monkeypatch):
    class Paused(RunObserver):
        paused_seconds = 0.0

    observer = Paused()

    def paused_run(robot, perception, request, observer):
        observer.paused_seconds += 1000.0
        return TaskResult(timings={"scan": 1.0}, failure="no viewpoint")

    monkeypatch.setattr(episode, "run_pipeline", paused_run)
    perception = object.__new__(Perception)
    report, _ = run_episode(cell, PackOptions(objects="can=1", seed=1), "pack", perception, observer)
    assert -1000.0 < report.timings["total"] < -900.0  # measured time less the claimed pause
    assert report.timings["scan"] == 1.0
    assert not report.success and report.reason == "0 of 1 objects in place; no viewpoint"


def test_true_shapes_reach_the_pipeline_on_request_alone(cell):
    before = read_truth(cell)

    def refuse():
        raise TruthRead

    for shapes in ("nodeslam", "tsdf"):
        reconstruction = reconstruction_of(PackOptions(shapes=shapes), refuse)
        reachable = inspect.getclosurevars(reconstruction).nonlocals if reconstruction else {}
        assert "read" not in reachable
        assert (reconstruction is None) == (shapes == "nodeslam")
    oracle = reconstruction_of(PackOptions(shapes="oracle"), lambda: before)
    assert oracle is not None
    (estimate,) = oracle([], None)
    np.testing.assert_allclose(estimate.T_world_object[:2, 3], before.poses[0][:2, 3], atol=1e-9)


def test_a_request_reads_no_ground_truth(cell, monkeypatch):
    def refuse(world):
        raise TruthRead

    monkeypatch.setattr(episode, "read_truth", refuse)
    for shapes in ("nodeslam", "tsdf"):
        assert request_of(cell, "pack", PackOptions(shapes=shapes)).task == "pack"
    oracle = request_of(cell, "pack", PackOptions(shapes="oracle")).reconstruction
    with pytest.raises(TruthRead):
        oracle([], None)


def test_settings_determine_an_episode_apart_from_its_seed():
    settings = settings_of(PackOptions(seed=5, box="0.3,0.3,0.1", quiet=True))
    assert settings["box"] == "0.3,0.3,0.1" and settings["shapes"] == "nodeslam"
    assert not {"seed", "out", "quiet", "json", "view", "port"} & set(settings)


def test_summary():
    placed, wrong = ObjectReport(0, "can", True), ObjectReport(1, "mug", False, reason="toppled by 90 deg")
    assert summary_of([placed], "") == "1 of 1 objects in place"
    assert (
        summary_of([placed], "", [{"moved": False}, {"moved": True}])
        == "1 of 1 objects in place; 1 thing of no class moved"
    )
    assert summary_of([placed, wrong], "") == "1 of 2 objects in place; mug 1: toppled by 90 deg"
    assert summary_of([placed, wrong], "no plan") == "1 of 2 objects in place; no plan"


SEEN = PoseCheck(np.eye(4), "seen", 0.9, 500, 0.01, 0.02)


@pytest.mark.parametrize(
    ("check", "in_place"),
    [
        (SEEN, True),
        (replace(SEEN, shift=0.029, tilt=float(np.deg2rad(9.9))), True),
        (replace(SEEN, shift=0.031), False),
        (replace(SEEN, tilt=float(np.deg2rad(10.1))), False),
        (replace(SEEN, status="not_there"), False),
    ],
)
def test_the_robots_own_verification_is_reported_beside_the_score(check, in_place):
    entry = ObjectReport(4, "can", False, reason="toppled by 90 deg", details={"size": 0.1})
    checked = with_check(entry, TaskResult(checks={4: check}))
    assert checked.details["seen_in_place"] is in_place and checked.details["size"] == 0.1
    assert checked.details["seen_shift"] == check.shift and checked.details["seen_tilt"] == check.tilt
    assert checked.placed is False and checked.reason == entry.reason  # the score is that of the scorer
    assert with_check(entry, TaskResult(checks={5: check})) is entry
