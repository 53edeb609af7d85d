"""Evaluation of reconstructions: tables from rows, resumption, the protocol; one object for real."""

import json
from pathlib import Path

import pytest
import trimesh

from app.errors import UsageError
from app.evaluation import reconstruction as evaluate_reconstruction
from app.evaluation.reconstruction import choose_subjects
from app.evaluation.reconstruction_object import Subject
from app.options import EvaluateOptions
from app.screen import Screen


def options(out: Path | None = None, **changes) -> EvaluateOptions:
    fields = {"what": "reconstruction", "objects": "mug=2,can=1", "views": (1,), "methods": ("full",)}
    return EvaluateOptions(**({"seed": 3, "out": out, "quiet": True} | fields | changes))


def row(name: str, views: int, method: str, accuracy: float, **more) -> dict:
    figures = {"accuracy": accuracy, "chamfer_l1": 2 * accuracy, "completion": 0.9, "seconds": 1.0}
    fields = {"object": name, "category": name[:3], "views": views, "method": method, "found": True}
    return fields | figures | {"status": "converged"} | more


@pytest.fixture
def quick(monkeypatch):
    """Replaces the work on an object; records it, and can be interrupted."""
    done: list[str] = []
    interrupted: set[str] = set()

    def evaluate(options: EvaluateOptions, subject: Subject) -> dict:
        if subject.name in interrupted:
            raise KeyboardInterrupt
        done.append(subject.name)
        return {"object": subject.name, "rows": [row(subject.name, 1, "dvr", 0.002)]}

    evaluate.done, evaluate.interrupted = done, interrupted
    monkeypatch.setattr(evaluate_reconstruction, "evaluate_subject", evaluate)
    return evaluate


def test_interrupted_evaluation_goes_on_where_it_stopped(tmp_path, quick) -> None:
    quick.interrupted.add("can_000")
    with pytest.raises(KeyboardInterrupt):
        evaluate_reconstruction.run(options(tmp_path, methods=("dvr",)), Screen(quiet=True))
    kept = json.loads((tmp_path / "report.json").read_text())
    assert not kept["success"] and kept["reason"] == "2 of 3 objects" and len(kept["metrics"]["rows"]) == 2
    quick.interrupted.clear()
    report = evaluate_reconstruction.run(options(tmp_path, methods=("dvr",), resume=True), Screen(quiet=True))
    assert report.success and quick.done == ["mug_000", "mug_001", "can_000"]


def test_a_failed_object_is_not_found_by_any_method_and_the_rest_goes_on(tmp_path, monkeypatch) -> None:
    def evaluate(options: EvaluateOptions, subject: Subject) -> dict:
        if subject.name == "mug_001":
            raise ValueError("no plane")
        rows = [row(subject.name, 1, method, 0.002) for method in options.methods]
        return {"object": subject.name, "rows": rows}

    monkeypatch.setattr(evaluate_reconstruction, "evaluate_subject", evaluate)
    asked = options(tmp_path, methods=("dvr", "tsdf"))
    report = evaluate_reconstruction.run(asked, Screen(quiet=True))
    assert not report.success and report.reason == "3 of 3 objects, 1 failed"
    mugs = [entry for entry in report.metrics["median"] if entry["category"] == "mug"]
    assert [(entry["method"], entry["n"], entry["found"]) for entry in mugs] == [
        ("dvr", 2, 0.5),
        ("tsdf", 2, 0.5),
    ]
    failed = [entry for entry in report.metrics["rows"] if not entry["found"]]
    assert {entry["reason"] for entry in failed} == {"crashed: ValueError: no plane"} and len(failed) == 2


def test_lines_without_all_rows_are_evaluated_again(tmp_path, quick) -> None:
    asked = options(tmp_path, methods=("dvr",))
    evaluate_reconstruction.run(asked, Screen(quiet=True))
    path = tmp_path / evaluate_reconstruction.ROWS
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines[0]["rows"] = []
    del lines[1]["rows"][0]["accuracy"]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    evaluate_reconstruction.run(options(tmp_path, methods=("dvr",), resume=True), Screen(quiet=True))
    assert quick.done == ["mug_000", "mug_001", "can_000", "mug_000", "mug_001"]


def test_resuming_with_other_views_is_refused(tmp_path, quick) -> None:
    evaluate_reconstruction.run(options(tmp_path, methods=("dvr",)), Screen(quiet=True))
    with pytest.raises(UsageError, match="was made with another views"):
        evaluate_reconstruction.run(
            options(tmp_path, methods=("dvr",), views=(1, 2), resume=True), Screen(quiet=True)
        )


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"views": (0, 1)}, "--views takes numbers from 1 to 20"),
        ({"views": (1, 1)}, "--views names one twice"),
        ({"methods": ()}, "--methods needs at least one"),
        ({"poses": ()}, "--poses needs at least one"),
        ({"poses": ("lying", "lying")}, "--poses names one twice"),
        ({"poses": ("lying",), "methods": ("dvr",)}, "by the method full: add it"),
        ({"object_meshes": Path("/nowhere")}, "--object-meshes /nowhere is no folder"),
        ({"objects": "mug=99999"}, "1 to 10000 are possible"),
    ],
)
def test_what_makes_no_sense_is_refused(changes, message, tmp_path) -> None:
    with pytest.raises(UsageError, match=message):
        evaluate_reconstruction.run(options(tmp_path, **changes), Screen(quiet=True))


def test_users_meshes_become_subjects(tmp_path) -> None:
    (tmp_path / "can").mkdir()
    trimesh.creation.cylinder(0.03, 0.1).export(tmp_path / "can" / "soup.ply")
    (subject,) = choose_subjects(options(object_meshes=tmp_path))
    assert (subject.name, subject.category, subject.followed) == ("can_000_soup", "can", True)


def test_subjects_are_repeated_in_every_pose_in_which_their_class_rests() -> None:
    subjects = choose_subjects(options(objects="bowl=1,can=1", poses=("upright", "lying", "upside-down")))
    names = ["bowl_000", "can_000", "can_000_lying", "bowl_000_upside-down"]
    assert [subject.name for subject in subjects] == names
    assert not any(subject.followed for subject in subjects)
