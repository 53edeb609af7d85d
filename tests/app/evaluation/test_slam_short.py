"""Short runs: rotation of faults, results of crashes, and the summary."""

import json
from dataclasses import replace

import pytest

from app.evaluation import slam_short
from app.evaluation.slam_short import short_table, summarise_short
from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen


def entry(**more):
    return {
        "ape_mean": 0.004, "drift": 0.01, "drifted": False, "n_lost": 0, "ends_lost": False, "n_phantoms": 0,
        "n_frames": 50, "n_beyond": 0, "surfaces": {"0": 0.002},
        "moved_is_known": None, "relocalisations": 4, "relocalised": 4, "relocalised_wrongly": 0,
    } | more  # fmt: skip


def test_the_summary_counts_drifts_losses_and_relocalisations():
    lines = [
        {"key": 0, "variants": {"full": entry()}},
        {"key": 1, "variants": {"full": entry(drift=0.05, drifted=True, n_lost=7, relocalised=2)}},
        {"key": 2, "reason": "crashed: ValueError: x"},
    ]
    figures = summarise_short(lines)["variants"]["full"]
    assert figures["n"] == 2 and figures["n_failed"] == 1
    assert figures["n_drifted"] == 1 and figures["n_with_loss"] == 1
    assert figures["lost_share"] == pytest.approx(0.07) and figures["accuracy_median"] == 0.002
    assert figures["drift_max"] == pytest.approx(0.05)
    assert figures["relocalisation_rate"] == pytest.approx(0.75)
    lines[0]["variants"]["no_joint"] = entry(ape_mean=0.006)
    assert summarise_short(lines)["against_full"]["no_joint"]["n"] == 1
    table = short_table(Report("evaluate slam", 0, metrics=summarise_short(lines)))
    assert table.row_count == 2


def test_faults_rotate_and_failed_runs_are_reported(tmp_path, monkeypatch):
    seen = []

    def broken(options, index, close_up, fault):
        seen.append((index, close_up, fault))
        if index == 1:
            raise RuntimeError("no light")
        return {"objects_in_view": 3.0, "variants": {"full": entry()}}

    monkeypatch.setattr(slam_short, "_run_variants", broken)
    options = EvaluateOptions(
        what="slam", short_runs=5, faults=("dark", "moved"), variants=("full",), out=tmp_path
    )
    report = slam_short.run(options, Screen(quiet=True))
    assert not report.success and report.reason == "5 of 5 short runs, 0 drifted, 1 crashed"
    assert report.metrics["rows"][1]["reason"] == "crashed: RuntimeError: no light"
    assert report.metrics["variants"]["full"]["n_failed"] == 1
    assert sorted(seen) == [
        (0, False, "dark"),
        (1, True, "dark"),
        (2, False, "moved"),
        (3, True, "moved"),
        (4, False, "dark"),
    ]
    path = tmp_path / slam_short.ROWS
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["key"] for line in lines] == [1, 3, 0, 2, 4]
    del lines[1]["variants"]["full"]["drift"]
    lines[2]["fault"] = "flicker"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    seen.clear()
    again = slam_short.run(replace(options, resume=True), Screen(quiet=True))
    assert [index for index, *_ in seen] == [3, 0]
    assert again.reason == report.reason


def test_a_report_of_failed_runs_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(slam_short, "_run_variants", lambda *_: 1 / 0)
    options = EvaluateOptions(what="slam", short_runs=2, out=tmp_path)
    report = slam_short.run(options, Screen(quiet=True))
    assert report.reason == "2 of 2 short runs, 0 drifted, 2 crashed" and report.metrics["variants"] == {}
