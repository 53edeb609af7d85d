"""Short runs: rotation of faults, results of crashes, and the summary."""

import pytest

from app.evaluation import slam_short
from app.evaluation.slam_short import run_short, short_table, summarise_short
from app.options import EvaluateOptions
from app.runs.report import Report


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
    assert figures["n"] == 2 and figures["n_drifted"] == 1 and figures["n_with_loss"] == 1
    assert figures["lost_share"] == pytest.approx(0.07) and figures["accuracy_median"] == 0.002
    assert figures["drift_max"] == pytest.approx(0.05)
    assert figures["relocalisation_rate"] == pytest.approx(0.75)
    lines[0]["variants"]["no_joint"] = entry(ape_mean=0.006)
    assert summarise_short(lines)["against_full"]["no_joint"]["n"] == 1
    table = short_table(Report("evaluate slam", 0, metrics=summarise_short(lines)))
    assert table.row_count == 2


def test_faults_rotate_and_a_crash_is_a_result(monkeypatch):
    seen = []

    def broken(options, index, close_up, fault):
        seen.append((index, close_up, fault))
        raise RuntimeError("no light")

    monkeypatch.setattr(slam_short, "_run_variants", broken)
    options = EvaluateOptions(what="slam", short_runs=6, faults=("dark", "moved"))
    lines = [run_short(options, index) for index in range(5)]
    assert lines[0]["reason"] == "crashed: RuntimeError: no light"
    assert seen == [
        (0, False, "dark"),
        (1, True, "dark"),
        (2, False, "moved"),
        (3, True, "moved"),
        (4, False, "dark"),
    ]
