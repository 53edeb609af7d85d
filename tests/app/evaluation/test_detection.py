"""The detection evaluation: which scenes it renders, and one small run from rendering to the table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.evaluation import detection
from app.options import EvaluateOptions
from app.screen import Screen
from sim_assets.datasets import training_scenes
from sim_assets.datasets.scene_config import TrainingSceneConfig


def options(out: Path, **changes: Any) -> EvaluateOptions:
    base = EvaluateOptions(
        what="detection", images=2, renderer="classic", out=out, device="cpu", seed=4, quiet=True
    )
    return replace(base, **changes)


class PoolDrawn(Exception):
    """Raised in place of rendering."""


def test_objects_and_distractors_are_of_the_test_split(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No training family and no training distractor is rendered."""
    drawn: list[tuple[str, str]] = []

    def spy(kind: str, function: Any, position: int) -> Any:
        def call(*arguments: Any) -> Any:
            drawn.append((kind, arguments[position]))
            return function(*arguments)

        return call

    def stop(things: Any, *_: Any) -> None:
        raise PoolDrawn([thing.category for thing in things])

    monkeypatch.setattr(
        training_scenes, "sample_parameters", spy("object", training_scenes.sample_parameters, 1)
    )
    monkeypatch.setattr(
        training_scenes, "random_distractor", spy("distractor", training_scenes.random_distractor, 1)
    )
    monkeypatch.setattr(training_scenes, "random_parts", spy("odd", training_scenes.random_parts, 0))
    monkeypatch.setattr(training_scenes, "TableTop", stop)
    with pytest.raises(PoolDrawn) as caught:
        detection.run_chunk(options(tmp_path), tmp_path, 0)
    (categories,) = caught.value.args
    assert set(drawn) == {("object", "test"), ("distractor", "test")}
    assert categories.count(None) == 12
    assert all(categories.count(name) == 6 for name in ("mug", "bowl", "bottle", "can"))


@pytest.mark.parametrize("rooms", [False, True])
def test_the_scenes_are_those_of_the_option(tmp_path: Path, rooms: bool) -> None:
    config = detection._scene_config(options(tmp_path, rooms=rooms))
    assert (config.room is not None) == (config.household > 0) == rooms
    assert config.toppled == 0 and config.pictures_per_pool == detection.CHUNK


@pytest.mark.parametrize(
    ("noise", "shares"),
    [("none", (1, 0, 0, 0, 0)), ("gaussian", (0, 1, 0, 0, 0)), ("tof", (0, 0, 0, 0, 1))],
)
def test_scenes_have_distractors_and_the_asked_depth_noise(
    tmp_path: Path, noise: Any, shares: tuple[float, ...]
) -> None:
    config = detection._scene_config(options(tmp_path, depth_noise=noise))
    assert config.noises == shares and config.renderer == "classic"
    assert config.objects == (4, 10) and config.extras == (1, 4)
    assert config.random_parts == 0 and config.drawn_in == 0  # training-only variations


@pytest.fixture
def small_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    config = TrainingSceneConfig(
        width=640, height=480, pool=4, distractors=2, objects=(3, 4), extras=(1, 1), textures_redrawn=2
    )
    monkeypatch.setattr(detection, "_scene_config", lambda _: config)


@pytest.mark.usefixtures("small_scenes")
def test_a_run_from_rendering_to_the_table(tmp_path: Path) -> None:
    report = detection.run(options(tmp_path), Screen(quiet=True))
    assert report.success and report.metrics["images"] == 2 and report.metrics["objects"] > 2
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 2
    assert detection.detection_table(report.metrics).row_count == 14
    again = detection.run(options(tmp_path, resume=True), Screen(quiet=True))
    assert again.metrics["map50"] == report.metrics["map50"] and again.timings["total"] < 5


def test_each_chunk_has_its_own_seed_and_the_last_one_the_remaining_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []
    counts: list[int] = []

    class Recorded:
        def __init__(self, split: str, seed: int, *_: Any) -> None:
            seeds.append(seed)

        def __enter__(self) -> Recorded:
            return self

        def __exit__(self, *_: object) -> None:
            return None

        def render(self, count: int) -> list[Any]:
            counts.append(count)
            return []

    monkeypatch.setattr(training_scenes, "TrainingScenes", Recorded)
    asked = options(tmp_path, images=2 * detection.CHUNK + 3)
    for chunk in (0, 1, 2):
        detection.run_chunk(asked, tmp_path, chunk)
    detection.run_chunk(replace(asked, seed=5), tmp_path, 0)
    assert counts == [detection.CHUNK, detection.CHUNK, 3, detection.CHUNK]
    assert len(set(seeds)) == 4


def test_a_failed_chunk_is_reported_and_the_rest_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[int] = []

    def work(options: EvaluateOptions, folder: Path, chunk: int) -> dict[str, Any]:
        ran.append(chunk)
        if chunk == 0:
            raise ValueError("no light")
        image = {"objects": [], "distractors": [], "detections": [], "seconds": 0.1}
        return {"chunk": chunk, "images": [image] * 3}

    monkeypatch.setattr(detection, "run_chunk", work)
    asked = options(tmp_path, images=detection.CHUNK + 3)
    report = detection.run(asked, Screen(quiet=True))
    assert not report.success and report.reason == "3 of 23 images, 1 chunks failed"
    assert report.warnings == ["chunk 0: crashed: ValueError: no light"]
    path = tmp_path / detection.ROWS
    path.write_text(path.read_text().replace(', "detections": []', "", 1))
    again = detection.run(replace(asked, resume=True), Screen(quiet=True))
    assert ran == [0, 1, 1] and again.metrics == report.metrics


def test_pictures_of_the_fewest_and_of_the_most_errors_are_kept() -> None:
    blank = np.zeros((2, 2, 3), np.uint8)
    pictures = [(errors, number, blank) for number, errors in enumerate((2, 0, 5, 3))]
    assert [entry[0] for entry in detection._best_and_worst(pictures)] == [0, 5]


def test_missed_and_misclassified_objects_and_taken_distractors_are_errors() -> None:
    line = {
        "objects": [
            {"counts": True, "found": "mug", "category": "mug"},
            {"counts": True, "found": "can", "category": "mug"},
            {"counts": True, "found": None, "category": "mug"},
            {"counts": False, "found": None, "category": "mug"},
        ],
        "distractors": [{"taken": True}, {"taken": False}],
    }
    assert detection._count_errors(line) == 3
