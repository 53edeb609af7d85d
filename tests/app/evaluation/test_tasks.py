"""Episodes of an evaluation: stored as they end, resumed after an interruption, with one seed each."""

import contextlib
import json
import sys
import types

import pytest

from app.errors import MissingExtraError, UsageError
from app.evaluation import tasks as evaluate_tasks
from app.evaluation.ledger import SETTINGS
from app.jobs import Failure
from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen


def options(out, **changes):
    fields = {"what": "tasks", "seed": 10, "episodes": 4, "out": out, "quiet": True}
    return EvaluateOptions(**(fields | changes))


@pytest.fixture
def episodes(monkeypatch):
    """Replaces real episodes by quick ones; records the seeds that were run, and can be interrupted."""
    ran = []

    def run_seed(options, seed):
        if seed in interrupted:
            raise KeyboardInterrupt
        ran.append(seed)
        thing = {"category": "can", "placed": seed % 2 == 0, "reason": "" if seed % 2 == 0 else "toppled"}
        return {"seed": seed, "success": seed % 2 == 0, "reason": "", "objects": [thing], "wall_seconds": 1.0}

    interrupted = set()
    monkeypatch.setattr(evaluate_tasks, "run_seed", run_seed)
    run_seed.ran, run_seed.interrupted = ran, interrupted
    return run_seed


def report_in(folder):
    return json.loads((folder / "report.json").read_text())


def test_rates_intervals_and_failures_are_reported(tmp_path, episodes):
    report = evaluate_tasks.run(options(tmp_path), Screen(quiet=True))
    assert episodes.ran == [10, 11, 12, 13] and report.success
    metrics = report_in(tmp_path)["metrics"]
    assert metrics["success_rate"] == 0.5 and metrics["object_success_rate"] == 0.5
    low, high = metrics["success_rate_ci"]
    assert 0 < low < 0.5 < high < 1
    assert metrics["failures"] == {"can: toppled": 2}


def test_an_interrupted_evaluation_keeps_finished_episodes_and_resumes(tmp_path, episodes):
    episodes.interrupted.add(12)
    with pytest.raises(KeyboardInterrupt):
        evaluate_tasks.run(options(tmp_path), Screen(quiet=True))
    kept = report_in(tmp_path)
    assert not kept["success"] and kept["metrics"]["n_episodes"] == 2 and "2 of 4 episodes" in kept["reason"]
    with (tmp_path / "episodes.jsonl").open("a") as file:
        file.write('{"seed": 12, "succ')  # killed while writing
    episodes.interrupted.clear()
    report = evaluate_tasks.run(options(tmp_path, resume=True), Screen(quiet=True))
    assert episodes.ran == [10, 11, 12, 13]
    assert report.success and report.metrics["n_episodes"] == 4
    lines = [json.loads(line) for line in (tmp_path / "episodes.jsonl").read_text().splitlines()]
    assert sorted(line["seed"] for line in lines) == [10, 11, 12, 13]


def test_a_new_evaluation_removes_stored_episodes(tmp_path, episodes):
    evaluate_tasks.run(options(tmp_path, episodes=2), Screen(quiet=True))
    evaluate_tasks.run(options(tmp_path, episodes=2), Screen(quiet=True))
    assert episodes.ran == [10, 11, 10, 11]


def test_options_missing_from_a_stored_evaluation_had_their_default(tmp_path, episodes):
    evaluate_tasks.run(options(tmp_path), Screen(quiet=True))
    settings = json.loads((tmp_path / SETTINGS).read_text())
    assert settings.pop("robot") == "panda"
    (tmp_path / SETTINGS).write_text(json.dumps(settings))
    evaluate_tasks.run(options(tmp_path, resume=True), Screen(quiet=True))
    with pytest.raises(UsageError, match="another robot"):
        evaluate_tasks.run(options(tmp_path, resume=True, robot="sixaxis"), Screen(quiet=True))


def test_resuming_with_other_settings_is_refused(tmp_path, episodes):
    evaluate_tasks.run(options(tmp_path, episodes=1), Screen(quiet=True))
    with pytest.raises(UsageError, match="was made with another box, task"):
        evaluate_tasks.run(options(tmp_path, resume=True, task="sort", box="0.4,0.3,0.1"), Screen(quiet=True))


def test_an_episode_has_its_own_seed_cell_and_networks(monkeypatch):
    calls = []

    def build(options, task):
        calls.append(("cell", options.seed, task))
        return contextlib.nullcontext("world")

    def run_episode(world, options, task, perception, perceive_only):
        calls.append((world, options.seed, task, perception, perceive_only))
        return Report(task, options.seed, True, "2 of 2", metrics={"n_placed": 2}), None

    monkeypatch.setattr("app.task.cell.build_world", build)
    monkeypatch.setitem(sys.modules, "app.task.episode", types.SimpleNamespace(run_episode=run_episode))
    monkeypatch.setattr(evaluate_tasks, "networks_on", lambda device: f"networks on {device}")
    line = evaluate_tasks.run_seed(options(None, task="sort", device="cpu", seed=10), 17)
    assert calls == [("cell", 17, "sort"), ("world", 17, "sort", "networks on cpu", False)]
    assert (line["seed"], line["task"], line["success"], line["reason"]) == (17, "sort", True, "2 of 2")
    assert line["metrics"] == {"n_placed": 2} and line["wall_seconds"] >= 0


def test_a_seed_that_cannot_be_run_is_a_failed_episode_and_the_rest_goes_on(tmp_path, monkeypatch):
    def run_seed(options, seed):
        if seed == 11:
            raise UsageError("--objects 10: no room for object 9")
        return {"seed": seed, "success": True, "reason": "", "objects": [], "wall_seconds": 1.0}

    monkeypatch.setattr(evaluate_tasks, "run_seed", run_seed)
    report = evaluate_tasks.run(options(tmp_path), Screen(quiet=True))
    assert not report.success
    assert report.reason == "4 of 4 episodes, 3 of them complete, 1 not run to their end"
    assert report.metrics["success_rate"] == 0.75 and report.metrics["n_episodes"] == 4
    assert report.metrics["failures"]["failed: --objects N: no room for object N"] == 1
    again = evaluate_tasks.run(options(tmp_path, resume=True), Screen(quiet=True))
    assert again.metrics == report.metrics and again.reason == report.reason


def test_a_failed_episode_has_its_reason_and_time():
    line = evaluate_tasks.failed_seed(options(None), 3, Failure("crashed: ValueError: x", 2.5))
    assert line == {
        "seed": 3, "task": "pack", "success": False, "reason": "crashed: ValueError: x", "objects": [],
        "wall_seconds": 2.5, "failed": True,
    }  # fmt: skip


@pytest.mark.parametrize(
    "damage",
    [
        lambda line: line.pop("objects"),
        lambda line: line["objects"][0].pop("placed"),
        lambda line: line.update(success="yes"),
        lambda line: line["objects"][0].update(placed=7),
        lambda line: line.update(task="sort"),
        lambda line: line.update(objects=3),
    ],
)
def test_damaged_lines_are_run_again(tmp_path, episodes, damage):
    first = evaluate_tasks.run(options(tmp_path), Screen(quiet=True))
    path = tmp_path / "episodes.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    damage(lines[1])
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    again = evaluate_tasks.run(options(tmp_path, resume=True), Screen(quiet=True))
    assert episodes.ran == [10, 11, 12, 13, 11]
    assert again.metrics == first.metrics


def test_ray_without_ray_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[cluster\]'"):
        evaluate_tasks.run(options(tmp_path, ray="auto"), Screen(quiet=True))


def test_cells_run_the_same_seeds_and_are_compared(tmp_path, monkeypatch):
    ran = []

    def run_seed(options, seed):
        ran.append((options.shapes, options.scan_views, seed))
        thing = {"category": "can", "placed": options.scan_views == "6", "reason": "toppled"}
        return {"seed": seed, "success": True, "reason": "", "objects": [thing], "wall_seconds": 1.0}

    monkeypatch.setattr(evaluate_tasks, "run_seed", run_seed)
    some = options(tmp_path, episodes=2, scan_views="1,6")
    report = evaluate_tasks.run(some, Screen(quiet=True))
    assert ran == [(("nodeslam",), views, seed) for seed in (10, 11) for views in ("1", "6")], "in pairs"
    assert report.success and "4 of 4 episodes" in report.reason
    assert [row["n_placed"] for row in report_in(tmp_path)["metrics"]["cells"]] == [0, 2]
    assert (tmp_path / "study.svg").read_bytes().startswith(b"<?xml")
    lines = (tmp_path / "episodes.jsonl").read_text().splitlines()
    (tmp_path / "episodes.jsonl").write_text("\n".join(lines[:3]) + "\n")
    evaluate_tasks.run(options(tmp_path, episodes=2, scan_views="1,6", resume=True), Screen(quiet=True))
    assert ran[4:] == [(("nodeslam",), "6", 11)]
    with pytest.raises(UsageError, match="another scan_views"):
        evaluate_tasks.run(options(tmp_path, episodes=2, resume=True), Screen(quiet=True))
