"""Evaluation of reconstructions: tables from rows, resumption, the protocol; one object for real."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rich.console import Console

from app.errors import UsageError
from app.evaluation import reconstruction as evaluate_reconstruction
from app.evaluation.reconstruction import choose_subjects
from app.evaluation.reconstruction_object import PROTOCOL, Subject, _known, evaluate_subject
from app.evaluation.reconstruction_pictures import _convergence_plot, _shaded
from app.evaluation.reconstruction_summary import PAPER, reconstruction_tables, summarise_reconstruction
from app.options import METHODS, EvaluateOptions
from app.runs.report import Report
from app.screen import Screen
from perception.inference import ablations
from perception.types import ObjectDetection, TriangleMesh


def options(out: Path | None = None, **changes) -> EvaluateOptions:
    fields = {"what": "reconstruction", "objects": "mug=2,can=1", "views": (1,), "methods": ("full",)}
    return EvaluateOptions(**({"seed": 3, "out": out, "quiet": True} | fields | changes))


def row(name: str, views: int, method: str, accuracy: float, **more) -> dict:
    figures = {"accuracy": accuracy, "chamfer_l1": 2 * accuracy, "completion": 0.9, "seconds": 1.0}
    fields = {"object": name, "category": name[:3], "views": views, "method": method, "found": True}
    return fields | figures | {"status": "converged"} | more


LINES = [
    {
        "object": f"mug_00{k}",
        "rows": [
            row(f"mug_00{k}", 1, "full", 0.001 * (k + 1), handle_recall=0.5 * k, handle_visible=k > 0),
            row(f"mug_00{k}", 1, "dvr", 0.01, handle_recall=0.0, handle_visible=k > 0),
        ],
        "convergence": {"full": [[0, 0.02], [8, 0.01 * (k + 1)]], "dvr": [[0, None], [4, 0.02]]},
    }
    for k in range(3)
]


def test_medians_by_class_views_and_method() -> None:
    summary = summarise_reconstruction(LINES)
    full = next(m for m in summary["median"] if m["method"] == "full")
    assert (full["category"], full["views"], full["n"], full["found"]) == ("mug", 1, 3, 1.0)
    assert full["accuracy"] == pytest.approx(0.002) and full["chamfer_l1"] == pytest.approx(0.004)
    assert full["handle_recall"] == pytest.approx(0.5)
    assert full["handle_recall_visible"] == pytest.approx(0.75) and full["n_handle_visible"] == 2
    assert len(summary["rows"]) == 6


def test_objects_not_found_are_counted_and_left_out_of_medians() -> None:
    lost = {
        "object": "mug_003",
        "category": "mug",
        "views": 1,
        "method": "full",
        "found": False,
        "seconds": 0.1,
    }
    summary = summarise_reconstruction([*LINES, {"object": "mug_003", "rows": [lost]}])
    full = next(m for m in summary["median"] if m["method"] == "full")
    assert full["found"] == 0.75 and full["accuracy"] == pytest.approx(0.002)


def test_convergence_holds_the_last_value_and_counts_no_surface_as_far() -> None:
    curves = summarise_reconstruction(LINES)["convergence"]
    assert curves["full"] == {"iteration": [0, 8], "chamfer_l1": pytest.approx([0.02, 0.02])}
    assert curves["dvr"]["iteration"] == [0, 4] and np.isinf(curves["dvr"]["chamfer_l1"][0])
    assert len(_convergence_plot(curves).axes[0].lines) == 3  # two curves and the end of the budget


def test_table_shows_the_paper_beside_ours() -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    for table in reconstruction_tables(Report("", 0, metrics=summarise_reconstruction(LINES))):
        console.print(table)
    text = console.export_text()
    assert "2.00 (4.46)" in text and "4.00 (4.44)" in text and "90.0 (93.5)" in text
    assert "75" in text and "dvr" in text and "…" not in text


def test_methods_have_one_list_of_names() -> None:
    assert METHODS == ablations.METHODS and set(PAPER) < set(METHODS)


@pytest.mark.parametrize("method", [m for m in METHODS if m != "tsdf"])
def test_every_method_differs_from_the_product_and_keeps_its_budget(method) -> None:
    config = ablations.method_config(method, PROTOCOL)
    assert (config == PROTOCOL) == (method == "full")
    assert sum(stage.iterations for stage in config.stages) == 30 and config.start_views == 1


def test_fusion_is_no_configuration_of_the_fit() -> None:
    with pytest.raises(ValueError, match="not a configuration"):
        ablations.method_config("tsdf")


def test_parts_of_the_one_object_are_joined() -> None:
    def part(column: int, bowl: float) -> ObjectDetection:
        mask = np.zeros((4, 6), bool)
        mask[:, column] = True
        return ObjectDetection("bowl", 0.9, mask, np.array([0.0, bowl, 0.0, 0.0, 1 - bowl]))

    (joined,) = _known([part(1, 0.9), part(2, 0.8), part(5, 0.1)], "bowl")
    assert joined.mask[0].tolist() == [False, True, True, False, False, False]
    assert joined.category == "bowl" and joined.instance_id == 0
    (doubtful,) = _known([part(1, 0.1), part(2, 0.3)], "bowl")
    assert doubtful.mask[0].tolist() == [False, False, True, False, False, False]
    assert _known([], "bowl") == ()


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


def test_a_picture_of_a_mesh_is_lit_and_centred() -> None:
    ball = trimesh.creation.icosphere(3, 0.05)
    mesh = TriangleMesh(ball.vertices, ball.faces)
    image = _shaded(mesh, np.full((len(mesh.faces), 3), 200.0), np.array([0.4, 0, 0.3]), np.zeros(3), 0.05)
    covered = (image < 255).any(axis=2)
    assert covered[170, 170] and not covered[0].any() and not covered[:, -1].any()
    assert image[100, 170].mean() > image[240, 170].mean()  # light comes from above


def test_one_object_for_real() -> None:
    """A can from one view: everything from drawing it to its row."""
    line = evaluate_subject(options(methods=("full", "no_refinement")), Subject("can", 0))
    full, plain = line["rows"]
    assert line["object"] == "can_000" and full["found"] and "convergence" not in line
    assert 0 < full["accuracy"] < 0.004 and full["completion"] > 0.9
    assert full["surface_sigma"] > 0 and full["within_1_sigma"] < full["within_2_sigma"] <= 1
    assert plain["method"] == "no_refinement" and plain["accuracy"] != full["accuracy"]
    json.dumps(line)
