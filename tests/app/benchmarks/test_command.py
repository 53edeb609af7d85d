"""The speed table: how times are taken, and that every row runs and says what it is compared with."""

import json
import time

import numpy as np
import pytest
import torch

from app.benchmarks import command as bench
from app.benchmarks import rows
from app.benchmarks.machine import describe_machine
from app.benchmarks.reference import plain_decoder, plain_jacobian_rows, plain_render
from app.benchmarks.scene import square_view
from app.benchmarks.timing import Benchmark, TimingConfig, measure
from app.cli import run
from app.options import BenchOptions
from app.screen import Screen
from perception.rendering.renderer import RayBundle, render
from perception.shape.decoder import ShapeDecoder
from perception.shape.weights import load_weights

QUICK = TimingConfig(min_repeats=3, max_repeats=3, seconds=0.0)


def test_value_and_reference_are_timed_in_turns_and_scaled():
    calls = []
    benchmark = Benchmark(
        "sleep",
        "three times as long",
        lambda: (calls.append("job"), time.sleep(0.01)),
        lambda: (calls.append("reference"), time.sleep(0.03)),
        scale=0.5,
        reference_scale=0.5,
    )
    row = measure(benchmark, QUICK)
    assert calls == ["job", "reference"] * 4  # the first of each to warm up
    assert row.repeats == 3 and row.unit == "s"
    assert row.best <= row.value and row.value >= 0.005 and row.ratio > 1.2
    assert row.ratio == pytest.approx(row.reference_value / row.value)
    assert row.core_seconds < row.value  # sleeping needs no core


def test_expensive_jobs_are_repeated_half_as_often():
    benchmark = Benchmark("", "", lambda: None, lambda: None, expensive=True)
    config = TimingConfig(min_repeats=5, max_repeats=3, seconds=0.0)
    assert measure(benchmark, config).repeats == 3


def test_the_machine_is_named():
    machine = describe_machine("cpu")
    assert machine["processor"] and machine["cores"] >= 1 and machine["cuda"] is None
    assert {"python", "nodeslam", "torch", "warp-lang"} <= machine.keys()


@pytest.fixture(scope="module")
def decoder():
    return ShapeDecoder.load()


def test_references_compute_the_same(decoder):
    """Ratios mean something only if both sides of a row do the same."""
    grid, jacobian = rows._mean_mug(decoder)
    code = torch.zeros(16)
    np.testing.assert_allclose(plain_decoder(load_weights(), "mug")(code[None])[0], grid, atol=1e-5)

    rays, A = square_view(side=9)
    image = render(rows._uploaded(grid, jacobian, "cpu"), rays, A)
    plain = plain_render(torch.from_numpy(grid), rays, torch.from_numpy(A).float())
    assert (image.mask > 0.2).sum() > 10  # the mug is in the picture
    np.testing.assert_allclose(image.depth, plain.depth, atol=2e-3)  # the kernel skips what hardly matters
    few = RayBundle(rays.directions[30:34], rays.view[30:34], rays.depth_range, rays.samples)
    by_autograd = plain_jacobian_rows(grid, jacobian, few, A)()
    assert by_autograd.shape == (4, 16 + 12)
    scale = np.abs(image.d_code).max()
    np.testing.assert_allclose(image.d_code[30:34], by_autograd[:, :16], atol=0.05 * scale)


def test_rendering_and_decoding_rows_run(decoder):
    for benchmark in [*rows._rendering(decoder), *rows._decoding(decoder)]:
        benchmark.job()
        assert benchmark.name and benchmark.reference


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
