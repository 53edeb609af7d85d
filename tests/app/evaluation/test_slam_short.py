"""Faults as they are meant, rows of short runs, and what they say together."""

from dataclasses import replace

import numpy as np
import pytest

from app.evaluation import slam_short
from app.evaluation.slam_faults import flickering, held, with_fault
from app.evaluation.slam_short import run_short, short_table, summarise_short
from app.options import EvaluateOptions
from app.runs.report import Report
from perception.io.detections import encode_detections
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame

CAMERA = CameraIntrinsics(8, 6, 8.0, 8.0, 4.0, 3.0)


@pytest.fixture
def frames():
    """Four seconds at 30 Hz."""
    rgb, depth = np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 0.5, np.float32)
    return [RgbdFrame(k / 30, rgb, depth, CAMERA, np.eye(4)) for k in range(120)]


def test_a_held_sequence_keeps_its_order_and_the_first_pose_alone(frames):
    sequence = held(frames)
    read = list(sequence.frames())
    assert [number for number, _ in read] == list(range(120))
    assert read[0][1].T_world_camera is not None
    assert all(frame.T_world_camera is None for _, frame in read[1:])
    assert sequence.detections(3, frames[3]) is None
    found = encode_detections(3, [ObjectDetection("mug", 1.0, np.ones((6, 8), bool))])
    again = replace(sequence, entries={3: found}).detections(3, frames[3])
    assert again is not None and again[0].mask.all() and again[0].category == "mug"


def test_dropped_frames_leave_gaps(frames):
    ids = np.array(with_fault(frames, "dropped", np.random.default_rng(0)).ids)
    assert 70 < len(ids) < 110 and ids[0] == 0
    assert np.diff(ids).max() >= 6


def test_a_second_of_black_depth(frames):
    sequence = with_fault(frames, "dark", np.random.default_rng(0))
    dark = [number for number in sequence.ids if not sequence.read(number).depth.any()]
    assert len(dark) == 30 and dark[0] == 48
    assert frames[48].depth.any()  # the caller's are as they were


def test_masks_flicker():
    found = [ObjectDetection("mug", 1.0, np.ones((2, 2), bool))] * 1000
    assert 700 < len(flickering(found, np.random.default_rng(0))) < 800


def entry(**more):
    return {
        "ape_mean": 0.004, "drift": 0.01, "drifted": False, "n_lost": 0, "ends_lost": False, "n_phantoms": 0,
        "n_frames": 50, "n_beyond": 0, "surfaces": {"0": 0.002},
        "moved_is_known": None, "relocalisations": 4, "relocalised": 4, "relocalised_wrongly": 0,
    } | more  # fmt: skip


def test_what_the_runs_say_together():
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


def test_faults_go_round_and_a_crash_is_a_result(monkeypatch):
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
