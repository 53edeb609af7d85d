"""Where a scan's detections come from, and what stands in for missing camera poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app import reconstruct
from app.options import ReconstructOptions
from perception.errors import InvalidInputError
from perception.io.scan_folder import Scan
from perception.pipeline import load_huggingface
from perception.scans import usable_part
from perception.support_plane import fit_support_plane
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

LENS = CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)
DOWN = np.deg2rad(50)  # the camera looks at the table from this far above the horizon
UP = np.array([0.0, -np.cos(DOWN), -np.sin(DOWN)])  # the table's normal in the camera
DISTANCE = 0.6


def tilted_table() -> RgbdFrame:
    """What a camera without a pose measures of an empty table."""
    v, u = np.mgrid[:120, :160]
    rays = np.stack([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, np.ones_like(u, float)], axis=-1)
    depth = -DISTANCE * np.sin(DOWN) / (rays @ UP)
    noise = np.random.default_rng(0).normal(0, 0.001, depth.shape)
    return RgbdFrame(0.0, np.zeros((120, 160, 3), np.uint8), (depth + noise).astype(np.float32), LENS)


def mask() -> np.ndarray:
    found = np.zeros((120, 160), bool)
    found[40:70, 60:90] = True
    return found


class Classifier:
    """Calls every mask a bowl."""

    def classify(self, frame: RgbdFrame, plane: SupportPlane, masks: Any) -> list[ObjectDetection]:
        self.plane = plane
        return [ObjectDetection("bowl", 0.7, found) for found in masks]


def test_the_plane_is_found_where_nothing_says_which_way_is_up() -> None:
    plane = fit_support_plane([tilted_table()])
    np.testing.assert_allclose(plane.normal, UP, atol=0.01)
    assert plane.offset == pytest.approx(-DISTANCE * np.sin(DOWN), abs=0.003)


def test_masks_of_a_folder_are_classified_and_tied(monkeypatch: pytest.MonkeyPatch) -> None:
    classifier = Classifier()
    monkeypatch.setattr(reconstruct, "load_detector", lambda device: classifier)
    scan = Scan((tilted_table(), tilted_table()), None, (0, 1), masks=((mask(),), ()))
    plane = SupportPlane(UP, -DISTANCE * np.sin(DOWN))
    usable = usable_part(scan)
    assert len(usable.frames) == 1 and usable.masks == scan.masks[:1] and len(usable.warnings) == 1
    detections = reconstruct._detections(usable, plane, ReconstructOptions(scan=Path("mine")))
    ((found,),) = detections.per_frame
    assert found.category == "bowl" and found.instance_id is not None
    assert classifier.plane is plane and detections.plane is plane


def test_told_detections_come_before_masks_and_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        raise AssertionError("no network is needed")

    monkeypatch.setattr(reconstruct, "load_detector", refuse)
    told = ObjectDetection("mug", 1.0, mask(), instance_id=4)
    frame = replace(tilted_table(), T_world_camera=np.eye(4))
    scan = Scan((frame,), ((told,),), (0,), masks=((mask(),),))
    options = ReconstructOptions(scan=Path("mine"))
    assert reconstruct._detections(scan, SupportPlane(), options).per_frame == ((told,),)
    with pytest.raises(InvalidInputError, match="is empty"):
        reconstruct._detections(replace(scan, detections=((),)), SupportPlane(), options)


def test_other_detectors_are_named_in_full() -> None:
    with pytest.raises(InvalidInputError, match="neither shipped nor hf:MODEL"):
        load_huggingface("maskrcnn", "cpu")
