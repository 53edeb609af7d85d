"""Completion curves, rows and statistics by variant, paired differences, tables."""

import numpy as np
import pytest

from app.evaluation.slam_summary import (
    curve_with_band,
    interval_text,
    slam_tables,
    summarise_slam,
    write_plots,
)
from app.runs.report import Report


def test_a_curve_keeps_the_last_value_of_objects_with_fewer_updates():
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


def test_differences_to_the_full_variant_are_paired_by_scene_and_object():
    lines = [line(scene, "full", 0.003 + 0.001 * scene) for scene in range(3)]
    lines += [line(scene, "no_joint", 0.005 + 0.001 * scene) for scene in range(3)]
    for one in lines[3:]:
        one["objects"] = [
            {**o, "accuracy": o["accuracy"] + 0.001} if "accuracy" in o else o for o in one["objects"]
        ]
    added = summarise_slam(lines)["against_full"]["no_joint"]
    assert added["ape_mean"] == pytest.approx({"mean": 0.002, "low": 0.002, "high": 0.002, "n": 3})
    assert added["accuracy"]["n"] == 6 and added["accuracy"]["mean"] == pytest.approx(0.001)


def test_statistics_over_the_scenes_of_a_variant():
    full = summarise_slam([line(0, "full", 0.004, n_lost=2), line(1, "full", 0.006, n_lost=3)])
    full = full["variants"]["full"]
    assert full["ape_worst_scene"] == 0.006 and full["n_lost"] == 5
    assert full["n_objects"] == 4 and full["accuracy_median"] == pytest.approx(0.003)
    assert full["chamfer_l1_median"] == pytest.approx(0.004)
    assert full["completion_median"] == pytest.approx(0.95)
    assert summarise_slam([])["variants"] == {}


def test_intervals_are_scaled_and_signed():
    assert interval_text({"mean": 0.001, "low": -0.002, "high": 0.004}, 1000) == "+1.00 (-2.00 .. +4.00)"
    assert interval_text({"mean": 0.001, "low": None, "high": None}, 1000) == ""


def test_plots_are_written(tmp_path):
    lines = [line(0, "full", 0.004, completion_by_update=[[0.9, 1.0]]), line(0, "no_joint", 0.02)]
    write_plots(tmp_path, Report("evaluate slam", 0, metrics=summarise_slam(lines)))
    assert (tmp_path / "overview.png").read_bytes().startswith(b"\x89PNG")
