"""Which source of detections the command uses, and that it does without PyTorch on the CPU."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app import reconstruct
from app.errors import UsageError
from app.options import ReconstructOptions
from app.screen import Screen
from perception.errors import InvalidInputError
from perception.io.object_map import read_object_map
from perception.io.scan_folder import Scan, write_scan
from perception.pipeline import Detections, load_huggingface
from perception.support.surface import SupportSurface
from perception.types import CameraIntrinsics, ObjectDetection, RejectedObject, RgbdFrame, SupportPlane
from sim_assets.datasets.sequences import SequenceConfig, TableSequence

LENS = CameraIntrinsics(8, 6, 9.0, 9.0, 3.5, 2.5)
FRAME = RgbdFrame(0.0, np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32), LENS, np.eye(4))
LEVEL = (SupportSurface(SupportPlane(np.array([0.0, 0.0, -1.0]), -1.0)),)  # what the frame shows
GIVEN = ObjectDetection("bowl", 1.0, np.ones((6, 8), bool), instance_id=4)


def test_detections_of_the_folder_take_precedence(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        raise AssertionError("no network is needed")

    monkeypatch.setattr(reconstruct, "load_detector", refuse)
    options = ReconstructOptions(scan=Path("mine"))
    scan = Scan((FRAME,), ((GIVEN,),), (0,))
    assert reconstruct._detections(scan, LEVEL, options).per_frame == ((GIVEN,),)
    with pytest.raises(InvalidInputError, match=r"^mine/detections\.json is empty"):
        reconstruct._detections(Scan((FRAME,), ((),), (0,)), LEVEL, options)


@pytest.mark.parametrize(
    ("scan", "own"),
    [
        (Scan((FRAME,), ((GIVEN,),), (0,)), "detections.json"),
        (Scan((FRAME,), None, (0,), masks=((),)), "masks"),
    ],
)
def test_another_detector_is_refused_where_the_folder_has_its_own_objects(scan: Scan, own: str) -> None:
    asked = ReconstructOptions(scan=Path("mine"), detector="hf:model")
    with pytest.raises(UsageError, match=f"^--detector hf:model: mine has {own}, which would be used"):
        reconstruct._check_detector(asked, scan)
    reconstruct._check_detector(ReconstructOptions(scan=Path("mine")), scan)
    reconstruct._check_detector(asked, Scan((FRAME,), None, (0,)))


def test_the_shipped_detector_is_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Detections(SupportPlane(), ((GIVEN,),))
    monkeypatch.setattr(reconstruct, "load_detector", lambda device: f"detector on {device}")
    monkeypatch.setattr(
        reconstruct, "detect_objects", lambda frames, detector, surfaces: (made, frames, detector, surfaces)
    )
    detections = reconstruct._detections.__wrapped__  # without the check of the stub's type
    result = detections(
        Scan((FRAME,), None, (0,)), LEVEL, ReconstructOptions(scan=Path("mine"), device="cpu")
    )
    assert result == (made, (FRAME,), "detector on cpu", LEVEL)


def test_mugs_of_another_detector_get_a_yaw_distribution(monkeypatch: pytest.MonkeyPatch) -> None:
    class Yaws:
        def complete(self, frame: Any, plane: Any, detections: Any) -> list[ObjectDetection]:
            return [replace(d, yaw_probabilities=np.full(36, 1 / 36)) for d in detections]

    bare = ObjectDetection("mug", 1.0, np.ones((6, 8), bool))
    monkeypatch.setattr(reconstruct, "load_huggingface", lambda name, device: lambda frame: [bare])
    monkeypatch.setattr(reconstruct, "load_detector", lambda device: Yaws())
    monkeypatch.setattr(
        reconstruct,
        "place_detections",
        lambda frames, found, surfaces, complete: Detections(surfaces[0].plane, complete(found)),
    )
    options = ReconstructOptions(scan=Path("mine"), detector="hf:model", device="cpu")
    ((found,),) = reconstruct._detections(Scan((FRAME,), None, (0,)), LEVEL, options).per_frame
    assert found.category == "mug" and len(found.yaw_probabilities) == 36


def test_poses_are_written_for_the_numbers_of_the_folder() -> None:
    without = RgbdFrame(0.0, FRAME.rgb, FRAME.depth, LENS)
    images = reconstruct._posed_images(Scan((FRAME, without), None, (5, 8)))
    assert [image.id for image in images] == [5] and images[0].intrinsics is LENS


def test_the_summary_names_what_is_left_out() -> None:
    item = RejectedObject(2, "mug", "the fit failed")
    assert reconstruct._summary([], []) == ""
    assert reconstruct._summary([], [item]) == (
        "no object was reconstructed: mug_2 is left out: the fit failed"
    )


@pytest.mark.parametrize(
    ("statuses", "n_rejected", "n_images", "doubted"),
    [
        (["implausible", "implausible"], 0, 2, True),
        ([], 1, 2, True),
        (["implausible", "not_converged"], 1, 2, False),
        (["implausible"], 0, 1, False),  # one image cannot contradict another
        ([], 0, 2, False),
    ],
)
def test_cameras_are_doubted_when_nothing_fits(
    standing: Any, statuses: list[Any], n_rejected: int, n_images: int, doubted: bool
) -> None:
    objects = [replace(standing("can", i), status=status) for i, status in enumerate(statuses)]
    warnings = reconstruct._doubts(objects, n_rejected, n_images)
    assert [w for w in warnings if "from world to camera" in w] == warnings
    assert bool(warnings) == doubted


def test_other_detectors_are_named_in_full() -> None:
    with pytest.raises(InvalidInputError, match="neither shipped nor hf:MODEL"):
        load_huggingface("maskrcnn", "cpu")


@pytest.mark.parametrize("clutter", [False, True])
def test_other_resting_poses_are_looked_for_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clutter: bool
) -> None:
    class Called(Exception):
        pass

    def check(*_: Any, clutter: Any, **__: Any) -> Any:
        raise Called(clutter is not None and hasattr(clutter, "posed"))

    monkeypatch.setattr(reconstruct, "reconstruct_objects", check)
    config = SequenceConfig(frames=1, objects=2, categories=("mug", "can"), spread=0.1)
    write_scan(tmp_path / "scan", [image.frame for image in TableSequence(1, config).render()])
    options = ReconstructOptions(scan=tmp_path / "scan", out=tmp_path / "run", clutter=clutter, device="cpu")
    with pytest.raises(Called) as caught:
        reconstruct.run(options, Screen(quiet=True))
    assert caught.value.args == (clutter,)


def test_pytorch_is_not_loaded_on_the_cpu(tmp_path: Path) -> None:
    config = SequenceConfig(frames=1, objects=2, categories=("mug", "can"), spread=0.1)
    write_scan(tmp_path / "scan", [image.frame for image in TableSequence(1, config).render()])
    code = "import sys; from app.cli import run; code = run(sys.argv[1:])\n"
    code += "sys.exit(7 if 'torch' in sys.modules else code)"
    arguments = ["reconstruct", tmp_path / "scan", "--device", "cpu", "--out", tmp_path / "run", "--quiet"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert read_object_map(tmp_path / "run")
