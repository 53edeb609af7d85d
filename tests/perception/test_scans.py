"""Where a scan's plane and detections come from, and what replaces missing camera poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception import scans
from perception.errors import InvalidInputError
from perception.io.scan_folder import Scan, write_scan
from perception.pipeline import Detections, Perception
from perception.reconstruction import Reconstruction
from perception.scans import reconstruct, reconstruct_scan, scan_detections, scan_surfaces, usable_part
from perception.support.surface import SupportSurface
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

LENS = CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)
DOWN = np.deg2rad(50)  # the camera looks at the table from this far above the horizon
UP = np.array([0.0, -np.cos(DOWN), -np.sin(DOWN)])  # the table's normal in the camera
DISTANCE = 0.6


LEVEL = (SupportSurface(SupportPlane()),)


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
    """A detector that classifies every mask as a bowl."""

    def complete(
        self, frame: RgbdFrame, plane: SupportPlane, detections: Sequence[ObjectDetection]
    ) -> list[ObjectDetection]:
        return [replace(d, yaw_probabilities=np.full(36, 1 / 36)) for d in detections]

    def classify(self, frame: RgbdFrame, plane: SupportPlane, masks: Any) -> list[ObjectDetection]:
        self.plane = plane
        return [ObjectDetection("bowl", 0.7, found) for found in masks]


def refuse() -> Any:
    raise AssertionError("no network is needed")


def test_the_plane_of_a_scan_without_poses_is_that_of_the_first_frame() -> None:
    (surface,) = scan_surfaces(
        Scan((tilted_table(), replace(tilted_table(), depth=0 * tilted_table().depth)), None, (0, 1))
    )
    plane = surface.plane
    np.testing.assert_allclose(plane.normal, UP, atol=0.01)
    assert plane.offset == pytest.approx(-DISTANCE * np.sin(DOWN), abs=0.003)


def test_without_poses_the_first_camera_is_the_world() -> None:
    detections = ((ObjectDetection("mug", 1.0, mask(), instance_id=4),), ())
    usable = usable_part(Scan((tilted_table(), tilted_table()), detections, (7, 8), ("image 9 is damaged",)))
    (frame,) = usable.frames
    np.testing.assert_array_equal(frame.T_world_camera, np.eye(4))
    assert usable.image_ids == (7,) and usable.detections == detections[:1]
    assert usable.warnings == (
        "image 9 is damaged",
        "the scan has no camera poses: 1 images after the first are not used",
    )
    assert usable_part(Scan((tilted_table(),), None, (0,))).warnings == ()


def test_a_scan_with_poses_is_used_completely() -> None:
    frame = replace(tilted_table(), T_world_camera=np.eye(4))
    scan = Scan((frame, frame), None, (0, 1))
    assert usable_part(scan) is scan


def test_masks_of_a_folder_are_classified_and_associated() -> None:
    classifier: Any = Classifier()
    scan = Scan((tilted_table(), tilted_table()), None, (0, 1), masks=((mask(),), ()))
    plane = SupportPlane(UP, -DISTANCE * np.sin(DOWN))
    usable = usable_part(scan)
    assert len(usable.frames) == 1 and usable.masks == scan.masks[:1] and len(usable.warnings) == 1
    detections = scan_detections(usable, (SupportSurface(plane),), lambda: classifier)
    assert detections is not None
    ((found,),) = detections.per_frame
    assert found.category == "bowl" and found.instance_id is not None
    assert classifier.plane is plane and detections.plane is plane


def test_given_detections_take_precedence_over_masks_and_networks() -> None:
    given = ObjectDetection("mug", 1.0, mask(), instance_id=4, yaw_probabilities=np.full(36, 1 / 36))
    frame = replace(tilted_table(), T_world_camera=np.eye(4))
    scan = Scan((frame,), ((given,),), (0,), masks=((mask(),),))
    detections = scan_detections(scan, LEVEL, refuse)
    assert detections is not None and detections.per_frame == ((given,),)
    bare = replace(scan, detections=None, masks=None)
    assert scan_detections(bare, LEVEL, refuse) is None
    with pytest.raises(InvalidInputError, match=r"^mine/detections.json is empty: delete it"):
        scan_detections(replace(scan, detections=((),)), LEVEL, refuse, Path("mine"))


def test_detections_without_instances_are_associated() -> None:
    given = ObjectDetection("bowl", 1.0, mask())
    frame = replace(tilted_table(), T_world_camera=np.eye(4))
    plane = SupportPlane(UP, -DISTANCE * np.sin(DOWN))
    detections = scan_detections(Scan((frame,), ((given,),), (0,)), (SupportSurface(plane),), refuse)
    assert detections is not None and detections.per_frame[0][0].instance_id is not None


def test_mugs_among_given_detections_get_a_yaw_distribution() -> None:
    classifier: Any = Classifier()
    mug, bowl = (ObjectDetection(c, 1.0, mask(), instance_id=k) for k, c in enumerate(("mug", "bowl")))
    frame = replace(tilted_table(), T_world_camera=np.eye(4))
    detections = scan_detections(Scan((frame,), ((mug, bowl),), (0,)), LEVEL, lambda: classifier)
    assert detections is not None
    ((first, second),) = detections.per_frame
    assert (first.instance_id, len(first.yaw_probabilities)) == (0, 36) and second is bowl


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Replace detection and reconstruction; return what they were called with."""
    seen: dict[str, Any] = {}

    def detect(frames: Any, detector: Any, surfaces: Any) -> Detections:
        seen["detected"] = (frames, detector, surfaces[0].plane)
        return Detections(surfaces[0].plane, tuple(() for _ in frames))

    def reconstruct_objects(frames: Any, detections: Detections, decoder: Any, on_rejected: Any) -> list[Any]:
        seen["reconstructed"] = (frames, detections, decoder)
        return []

    monkeypatch.setattr(scans, "detect", detect)
    monkeypatch.setattr(scans, "reconstruct_objects", reconstruct_objects)
    stub = object.__new__(Perception)  # no network is loaded
    for name in ("detector", "decoder"):
        object.__setattr__(stub, name, name)
    monkeypatch.setattr(scans, "shipped_perception", lambda: stub)
    return seen


def test_a_single_frame_without_pose_is_reconstructed_in_its_camera(stages: dict[str, Any]) -> None:
    result = reconstruct([tilted_table()])
    assert isinstance(result, Reconstruction) and not result.posed
    np.testing.assert_array_equal(result.T_world_camera, np.eye(4))
    np.testing.assert_allclose(result.plane.normal, UP, atol=0.01)
    frames, detector, plane = stages["detected"]
    np.testing.assert_array_equal(frames[0].T_world_camera, np.eye(4))
    assert detector == "detector" and plane is result.plane and stages["reconstructed"][2] == "decoder"


def test_frames_with_poses_are_reconstructed_in_the_world(stages: dict[str, Any]) -> None:
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, -np.sin(DOWN), np.cos(DOWN)], [0, -np.cos(DOWN), -np.sin(DOWN)]]
    T[2, 3] = DISTANCE * np.sin(DOWN)
    frame = replace(tilted_table(), T_world_camera=T)
    single = reconstruct([frame])
    assert single.posed
    np.testing.assert_allclose(single.plane.normal, (0, 0, 1), atol=0.01)
    np.testing.assert_array_equal(single.T_world_camera, T)
    assert reconstruct([frame, frame]).T_world_camera is None
    with pytest.raises(InvalidInputError, match="a support plane from 2 frames needs T_world_camera of each"):
        reconstruct([frame, tilted_table()])


def test_given_detections_replace_the_detector(stages: dict[str, Any]) -> None:
    given = Detections(SupportPlane(UP, -0.4), ((),))
    result = reconstruct([tilted_table()], detections=given)
    assert result.plane is given.plane and "detected" not in stages


def test_a_scan_folder_without_poses_uses_its_first_image(
    tmp_path: Path, stages: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    write_scan(tmp_path, [tilted_table(), tilted_table()])
    result = reconstruct_scan(tmp_path)
    assert not result.posed and len(stages["reconstructed"][0]) == 1
    assert "1 images after the first are not used" in caplog.text
    with pytest.raises(InvalidInputError, match="is not a folder"):
        reconstruct_scan(tmp_path / "missing")
