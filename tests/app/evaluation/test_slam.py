"""Curves with bands, rows as the report fixes them, matching by place, and errors as evo has them."""

import numpy as np
import pytest

from app.evaluation.slam_scoring import TrueObjects, absolute_pose_error
from app.evaluation.slam_summary import curve_with_band, slam_tables, summarise_slam
from app.runs.report import Report
from perception.io.recordings.trajectory import Trajectory
from perception.types import TriangleMesh


def test_a_curve_holds_its_last_value_and_has_a_band():
    curve = curve_with_band([[0.5, 0.9], [0.7]])
    assert curve["mean"] == pytest.approx([0.6, 0.8])
    half = 1.96 * np.std([0.5, 0.7], ddof=1) / np.sqrt(2)
    assert curve["low"][0] == pytest.approx(0.6 - half, abs=1e-3)
    assert curve["high"][1] <= 1.0 and curve["n"] == [2.0, 1.0]
    assert curve_with_band([])["mean"] == []


def line(scene, variant, ape, **more):
    objects = [
        {
            "category": "mug",
            "true_category": "mug",
            "true_index": 0,
            "accuracy": 0.002,
            "chamfer_l1": 0.003,
            "completion": 1.0,
        },
        {
            "category": "can",
            "true_category": "bottle",
            "true_index": 1,
            "accuracy": 0.004,
            "chamfer_l1": 0.005,
            "completion": 0.9,
        },
        {"category": "mug", "true_category": None},
    ]
    return {
        "scene": scene,
        "variant": variant,
        "ape_mean": ape,
        "ape_rmse": ape,
        "objects": objects,
        "n_true": 3,
    } | more


def test_rows_and_means_by_variant():
    lines = [line(0, "full", 0.004), line(1, "full", 0.006), line(0, "no_joint", 0.02)]
    lines.append({"scene": 1, "variant": "no_joint", "reason": "crashed: ValueError: x"})
    lines[0] |= {
        "completion_by_update": [[0.9, 1.0]],
        "tsdf": {"completion": [[0.5, 0.6]], "accuracy": [[0.002]]},
    }
    metrics = summarise_slam(lines)
    row = metrics["rows"][0]
    assert row["n_objects"] == 2 and row["n_wrong_class"] == 1 and row["accuracy"] == pytest.approx(0.003)
    assert row["completion_by_update"] == pytest.approx([0.9, 1.0])
    assert metrics["variants"]["full"]["ape_mean"] == pytest.approx(0.005)
    assert metrics["variants"]["no_joint"]["n"] == 1
    assert metrics["variants"]["tsdf"]["accuracy_median"] == pytest.approx(0.002)
    assert set(metrics["completion_by_update"]) == {"full", "tsdf"}
    ape, surfaces, paired = slam_tables(Report("evaluate slam", 0, metrics=metrics))
    assert ape.row_count == 2 and surfaces.row_count == 3 and paired.row_count == 1


def test_what_a_variant_adds_is_judged_scene_by_scene_and_object_by_object():
    lines = [line(scene, "full", 0.003 + 0.001 * scene) for scene in range(3)]
    lines += [line(scene, "no_joint", 0.005 + 0.001 * scene) for scene in range(3)]
    for one in lines[3:]:
        one["objects"] = [
            {**o, "accuracy": o["accuracy"] + 0.001} if "accuracy" in o else o for o in one["objects"]
        ]
    added = summarise_slam(lines)["against_full"]["no_joint"]
    assert added["ape_mean"] == pytest.approx({"mean": 0.002, "low": 0.002, "high": 0.002, "n": 3})
    assert added["accuracy"]["n"] == 6 and added["accuracy"]["mean"] == pytest.approx(0.001)


def test_error_of_a_shifted_trajectory_is_the_shift():
    pytest.importorskip("evo")
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    moved = poses.copy()
    moved[:, 1, 3] += 0.02
    times = np.arange(5) / 30
    error = absolute_pose_error(Trajectory(times[1:], moved[1:]), Trajectory(times, poses))
    assert error == pytest.approx({"ape_mean": 0.02, "ape_rmse": 0.02, "ape_max": 0.02})


def test_true_objects_are_matched_by_place():
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    meshes = [("mug", TriangleMesh(corners + shift, faces)) for shift in (0.0, 0.5)]
    truth = TrueObjects(meshes, np.random.default_rng(0))

    places = {7: np.full(3, 0.56), 8: np.full(3, 0.06), 9: np.full(3, 2.0)}
    assert truth.match(places) == {7: 1, 8: 0}
    assert truth.match({}) == {}
