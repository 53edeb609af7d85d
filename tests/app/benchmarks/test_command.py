"""The speed table: its report after every row, and bad input."""

import json

from app.benchmarks import command as bench
from app.benchmarks.timing import Benchmark
from app.cli import run
from app.options import BenchOptions
from app.screen import Screen


def test_the_report_has_every_row_and_is_stored_after_each(tmp_path, monkeypatch, capsys):
    stored = []

    def jobs(*_):
        yield Benchmark("one thing", "another", lambda: None, lambda: None)
        stored.append(json.loads((tmp_path / "report.json").read_text()))
        yield Benchmark("two things", "another", lambda: None, lambda: None)

    monkeypatch.setattr(bench, "benchmarks", jobs)
    monkeypatch.setattr(bench, "prepare", lambda *_: None)
    report = bench.run(BenchOptions(out=tmp_path, repeats=1, quiet=True), Screen(quiet=True))
    assert [row["name"] for row in stored[0]["metrics"]["rows"]] == ["one thing"]
    assert not stored[0]["success"]
    assert report.success
    assert all(
        {"name", "value", "unit", "reference", "ratio"} <= row.keys() for row in report.metrics["rows"]
    )
    assert "torch" in json.loads((tmp_path / "report.json").read_text())["metrics"]["machine"]


def test_bad_input_is_refused(tmp_path, capsys):
    assert run(["bench", "--repeats", "0", "--out", str(tmp_path / "a")]) == 2
    assert "--repeats" in capsys.readouterr().err
    assert run(["bench", "--scan", str(tmp_path / "nothing"), "--out", str(tmp_path / "b")]) == 2
    assert "nothing" in capsys.readouterr().err
    assert run(["bench", "--growth", "--scan", str(tmp_path), "--out", str(tmp_path / "c")]) == 2
    assert "--growth measures scenes of its own: leave out --scan" in capsys.readouterr().err


def test_load_above_half_the_cores_is_a_warning():
    for load, n_warnings in ((2.0, 0), (2.1, 1)):
        report = bench._report(BenchOptions(), {"load": load, "cores": 4}, [], 1.0, done=True)
        assert len(report.warnings) == n_warnings
