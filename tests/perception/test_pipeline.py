"""The stages with stubs for the networks: plane, order, progress, devices."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch

from app import options
from perception import pipeline
from perception.detection.detector import Detector
from perception.detection.graph_predictors import GraphScenePredictor
from perception.detection.left_out import LeftOut
from perception.errors import InvalidInputError
from perception.pipeline import (
    Detections,
    detect,
    has_cuda,
    load_huggingface,
    load_perception,
    place_detections,
    reconstruct_objects,
    resolve_device,
)
from perception.shape.decoder import ShapeDecoder
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, ObjectEstimate, SupportPlane, TriangleMesh

TARGET = (0.45, -0.2, 0.03)


@pytest.fixture(scope="module")
def scan(scenes):
    """Three posed views of two cylinders."""
    solids = [scenes.Solid(0.42, -0.25, 0.10, radius=0.035), scenes.Solid(0.50, -0.15, 0.06, radius=0.03)]
    return [scenes.render(solids, scenes.orbit(TARGET, 0.5, 55, a)) for a in (0, 120, 240)]


class TruthDetector:
    """Returns the true masks of whichever frame it gets, the second object first."""

    def __init__(self, scan):
        self.scan, self.planes = scan, []

    def __call__(self, frame, plane):
        self.planes.append(plane)
        instances = next(s.instances for s in self.scan if s.frame is frame)
        return [ObjectDetection("can", 0.9, instances == k) for k in (1, 0)]


def test_detections_are_associated_and_in_the_order_of_the_frames(scan):
    calls = []
    found = detect([s.frame for s in scan], TruthDetector(scan), lambda *a: calls.append(a), workers=3)
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert found.n_objects == 2 and [len(row) for row in found.per_frame] == [2, 2, 2]
    solid_of_id = {
        (d.instance_id, int(np.bincount(s.instances[d.mask & (s.instances >= 0)]).argmax()))
        for s, row in zip(scan, found.per_frame)
        for d in row
    }
    assert len(solid_of_id) == 2  # masks belong to their own frame: each id is one solid in all of them
    np.testing.assert_allclose(found.plane.normal, (0, 0, 1), atol=1e-3)


def test_a_given_plane_is_used_instead_of_a_fit(scan, monkeypatch):
    plane, detector = SupportPlane(offset=0.001), TruthDetector(scan)
    monkeypatch.setattr(pipeline, "find_surfaces", None)
    found = detect([s.frame for s in scan], detector, plane=plane)
    assert found.plane is plane and all(used is plane for used in detector.planes)


def test_the_surfaces_are_found_and_returned(scan):
    found = detect([s.frame for s in scan], TruthDetector(scan))
    (surface,), (plane,) = found.surfaces, found.planes
    assert surface.plane is plane is found.plane
    assert len(surface.outline) > 2 and not found.left_out
    (alone,) = Detections(plane, ((),)).planes
    assert alone is plane


def test_without_any_object_the_things_in_depth_are_left_out(scan):
    frames = [s.frame for s in scan]
    found = detect(frames, lambda frame, plane: [])
    assert found.n_objects == 0
    for i, seen in enumerate(scan):
        there = [c for c in found.left_out if c.frame == i]
        assert {c.reason for c in there} == {"not recognised as an object"}
        covered = np.logical_or.reduce([c.mask for c in there])
        assert (covered & (seen.instances >= 0)).sum() > 0.6 * (seen.instances >= 0).sum()


def test_what_does_not_stand_on_a_surface_is_left_out_in_its_frame(scan):
    elsewhere = np.array([[2.0, 2.0], [3.0, 2.0], [3.0, 3.0], [2.0, 3.0]])
    surface = SupportSurface(SupportPlane(), elsewhere)
    found = detect([s.frame for s in scan], TruthDetector(scan), surfaces=[surface])
    assert found.n_objects == 0
    beyond = [c.frame for c in found.left_out if c.reason == "beyond the edge of the support surface"]
    assert sorted(beyond) == [0, 0, 1, 1, 2, 2]


def test_detections_without_depth_are_placed_completed_and_associated(scan):
    masks = [[ObjectDetection("can", 0.9, s.instances == k) for k in (0, 1)] for s in scan]

    def complete(rows):
        return [[replace(d, category="mug") for d in row] for row in rows]

    found = place_detections([s.frame for s in scan], masks, [SupportSurface(SupportPlane())], complete)
    assert found.n_objects == 2 and {d.category for row in found.per_frame for d in row} == {"mug"}


@pytest.fixture(scope="module")
def networks():
    return load_perception("cpu")


def test_reconstruction_gets_frames_detections_plane_and_callbacks(networks, monkeypatch):
    received = {}

    def reconstruct(frames, per_frame, decoder, plane, **callbacks):
        received.update(per_frame=per_frame, decoder=decoder, plane=plane, callbacks=callbacks)
        return []

    def progress(done, total, item=""):
        return None

    def on_step(*_):
        return None

    monkeypatch.setattr(pipeline, "reconstruct", reconstruct)
    detections = Detections(SupportPlane(), ())
    reconstruct_objects((), detections, networks.decoder, progress, on_step)
    assert received["per_frame"] == () and received["plane"] == (detections.plane,)
    assert received["decoder"] is networks.decoder
    assert progress in _flat(received["callbacks"]) and on_step in _flat(received["callbacks"])


def test_parts_of_things_are_left_out_with_the_reason(networks, monkeypatch):
    mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
    mugs = [ObjectEstimate(id, "mug", np.zeros(16), np.eye(4), np.ones(3), mesh, 0.9) for id in (2, 5)]
    monkeypatch.setattr(pipeline, "reconstruct", lambda *args, **options: mugs)
    monkeypatch.setattr(pipeline, "parts_of_things_in_one_view", lambda objects, *_: {objects[1].id})
    rejected = []
    detections = Detections(SupportPlane(), ())
    found = reconstruct_objects((), detections, networks.decoder, on_rejected=rejected.append)
    assert [e.id for e in found] == [2]
    assert [(r.id, r.category, r.score) for r in rejected] == [(5, "mug", 0.9)]
    assert "colour" in rejected[0].reason


def test_with_a_namer_of_parts_the_table_may_be_cluttered(networks, monkeypatch):
    received = []
    monkeypatch.setattr("perception.clutter.reconstruct_clutter", lambda *args: received.extend(args) or [])
    thing = LeftOut(np.ones((4, 4), np.bool_), "of none of the classes")
    detections = Detections(SupportPlane(), ((),), left_out=(thing,))
    assert reconstruct_objects((), detections, networks.decoder, clutter=networks.detector) == []
    assert received[:3] == [(), ((),), (thing,)]
    assert received[3:6] == [networks.decoder, detections.planes, networks.detector]


def _flat(callbacks):
    values = list(callbacks.values())
    return values + [v for value in values for v in getattr(value, "__dict__", {}).values()]


def test_perception_holds_the_shipped_detector_and_decoder(networks):
    assert isinstance(networks.detector, Detector) and isinstance(networks.decoder, ShapeDecoder)
    assert isinstance(networks.detector.scene_network, GraphScenePredictor)
    assert networks.decoder.device == "cpu"


@pytest.mark.parametrize(
    ("device", "available", "expected"),
    [("auto", True, "cuda"), ("auto", False, "cpu"), ("cpu", True, "cpu"), ("cuda", True, "cuda")],
)
def test_auto_is_cuda_where_it_is_available(monkeypatch, device, available, expected):
    monkeypatch.setattr(pipeline, "has_cuda", lambda: available)
    assert resolve_device(device) == expected


@pytest.mark.parametrize("both", [(True, True), (True, False), (False, True)])
def test_cuda_needs_warp_and_torch(monkeypatch, both):
    warp_can, torch_can = both
    monkeypatch.setattr(pipeline, "warp_has_cuda", lambda: warp_can)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: torch_can)
    assert has_cuda() is all(both)


def test_cuda_is_refused_where_it_is_not_available(monkeypatch):
    monkeypatch.setattr(pipeline, "has_cuda", lambda: False)
    with pytest.raises(InvalidInputError, match="no usable CUDA device; use --device cpu"):
        resolve_device("cuda")


def test_the_command_line_has_the_same_devices():
    assert get_args(options.Device) == get_args(pipeline.Device)


@pytest.mark.parametrize("name", ["maskrcnn", "hf:", "HF:model"])
def test_other_detectors_are_refused(name):
    with pytest.raises(InvalidInputError, match="neither shipped nor hf:MODEL"):
        load_huggingface(name, "cpu")
