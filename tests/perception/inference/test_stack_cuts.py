"""Where instances are cut, and that the networks must name both parts."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.inference import stack_cuts
from perception.inference.seams import Seam
from perception.inference.stack_cuts import RAISED_FLOOR, StackCuts
from perception.types import (
    POSED_CLASSES,
    CameraIntrinsics,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
    is_unclassified,
    unclassified,
)
from tests.perception.inference.namers import Namer

PLANE = SupportPlane()


@pytest.fixture
def rows(stack):
    return [[unclassified(view.mask, 4)] for view in stack.seen]


def frames_of(stack):
    return [view.frame for view in stack.seen]


def test_the_upper_part_is_named_on_the_seam_and_parts_without_a_class_are_none(stack, rows):
    namer = Namer()
    (parts, *_) = StackCuts(frames_of(stack), rows, [PLANE], namer).at_seams(4, 9)
    assert parts.ids == (9, 10)
    assert sorted(set(np.round(namer.bases[:6], 2))) == [0.0, pytest.approx(stack.height, abs=0.01)]
    assert {d.category for row in parts.rows for d in row} == {"can"}
    thing = Namer([0.1, 0.1, 0.05, 0.05, 0.7])
    assert StackCuts(frames_of(stack), rows, [PLANE], thing).at_seams(4, 9) == []


@pytest.mark.parametrize(
    ("network", "category"), [((0.1, 0.0, 0.1, 0.7, 0.1), "can"), ((0.2, 0, 0.5, 0, 0.3), "mug")]
)
def test_the_pose_network_is_asked_what_the_class_network_does_not_know(stack, rows, network, category):
    """Nothing stands on a bottle: the lower part is none to the class network, and a mug to both."""

    class OnMugs(Namer):
        def posed(self, frame, plane, detections):
            poses = np.array([posed == ("mug", "upright") for posed in POSED_CLASSES] + [False], float)
            return [replace(d, pose_probabilities=poses) for d in detections]

    (parts, *_) = StackCuts(frames_of(stack), rows, [PLANE], OnMugs(network)).at_seams(4, 9)
    assert {d.category for row in parts.rows for d in row if d.instance_id == 9} == {category}


def test_objects_of_two_colors_are_parts(stack, rows):
    """The lower one is red, the upper one blue; in one colour they are not parted."""
    namer = Namer()
    assert StackCuts(frames_of(stack), rows, [PLANE], namer).between_colors(4, 9) == []
    frames = []
    for view, upper in zip(stack.seen, stack.upper):
        rgb = np.where(upper[..., None], (30, 60, 200), (200, 40, 30)).astype(np.uint8)
        frames.append(replace(view.frame, rgb=rgb))
    (parts,) = StackCuts(frames, rows, [PLANE], namer).between_colors(4, 9)
    assert parts.ids == (9, 10)
    assert sorted(set(np.round(namer.bases, 2))) == [0.0, pytest.approx(stack.height, abs=0.02)]
    for row, upper in zip(parts.rows, stack.upper):
        (high,) = (d.mask for d in row if d.instance_id == 10)
        assert (high & upper).sum() > 0.95 * upper.sum() and (high & ~upper).sum() < 0.05 * upper.sum()
    for unsure in ([0.1, 0.1, 0.05, 0.05, 0.7], [0.1, 0.1, 0.05, 0.5, 0.25]):
        assert StackCuts(frames, rows, [PLANE], Namer(unsure)).between_colors(4, 9, True) == []


def test_below_a_clearly_named_object_a_part_may_be_without_a_name(stack, rows):
    """Only its rim is seen; what is no object with a single shape is not taken for one on another."""

    class KnowsTheUpper(Namer):
        def complete(self, frame, plane, detections):
            p = [0.0, 0.0, 0.0, 0.95, 0.05] if plane.offset > 0 else [0.0, 0.0, 0.0, 0.05, 0.95]
            return [replace(d, class_probabilities=np.array(p)) for d in detections]

        def posed(self, frame, plane, detections):
            return detections

    frames = []
    for view, upper in zip(stack.seen, stack.upper):
        rgb = np.where(upper[..., None], (30, 60, 200), (200, 40, 30)).astype(np.uint8)
        frames.append(replace(view.frame, rgb=rgb))
    (parts,) = StackCuts(frames, rows, [PLANE], KnowsTheUpper()).between_colors(4, 9, True)
    below = [d for row in parts.rows for d in row if d.instance_id == 9]
    assert below and all(is_unclassified(d) for d in below)
    assert StackCuts(frames, rows, [PLANE], KnowsTheUpper()).between_colors(4, 9) == []


def vessel_from_above(holds=False, floor=0.004):
    """A vessel of 0.06 m seen from above, with a cylinder of 0.025 m in it if it holds one."""
    v, u = np.mgrid[:160, :200]
    away = np.hypot(u - 99.5, v - 79.5) / 400.0  # of a pixel's ray from the axis at 1 m
    depth = np.full((160, 200), 0.6, np.float32)
    for radius, height in ((0.06, 0.05), (0.055, floor), *([(0.025, 0.035)] if holds else [])):
        depth[away * (0.6 - height) < radius] = 0.6 - height
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.6
    camera = CameraIntrinsics(200, 160, 400.0, 400.0, 99.5, 79.5)
    view = RgbdFrame(0.0, np.zeros((160, 200, 3), np.uint8), depth, camera, T)
    profile = [(0, 0), (0.06, 0), (0.06, 0.05), (0.055, 0.05), (0.055, 0.004), (0, 0.004)]
    shape = trimesh.creation.revolve(np.array(profile), sections=64)
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    vessel = ObjectEstimate(4, "bowl", np.zeros(16), np.eye(4), np.full(3, 0.07), mesh, 0.9)
    rows = [[ObjectDetection("bowl", 0.9, depth < 0.597, instance_id=4)]]
    return view, vessel, rows


def test_what_a_vessel_holds_below_its_rim_is_a_part_of_its_own():
    view, vessel, rows = vessel_from_above(holds=True)
    (parts,) = StackCuts([view], rows, [PLANE], Namer((0.0, 0.45, 0.0, 0.5, 0.05))).inside(4, 7, vessel)
    lower, upper = parts.rows[0]
    assert (lower.instance_id, lower.category) == (7, "bowl")
    assert (upper.instance_id, upper.category) == (8, "can")
    inner = np.isclose(view.depth, 0.565)
    assert (upper.mask & inner).sum() > 0.9 * inner.sum()
    assert (upper.mask & ~inner).sum() < 0.05 * inner.sum()
    assert not (upper.mask & lower.mask).any() and ((upper.mask | lower.mask) == rows[0][0].mask).all()


def test_empty_upside_down_and_closed_objects_hold_nothing():
    view, vessel, rows = vessel_from_above(holds=False)
    assert StackCuts([view], rows, [PLANE], Namer()).inside(4, 7, vessel) == []
    view, vessel, rows = vessel_from_above(holds=True)
    for other in (None, replace(vessel, resting="upside-down"), replace(vessel, category="can")):
        assert StackCuts([view], rows, [PLANE], Namer()).inside(4, 7, other) == []
    unnamed = Namer((0.0, 0.0, 0.0, 0.0, 1.0))
    assert StackCuts([view], rows, [PLANE], unnamed).inside(4, 7, vessel) == []


@pytest.mark.parametrize(("floor", "n_cuts"), [(RAISED_FLOOR - 0.002, 0), (RAISED_FLOOR + 0.002, 1)])
def test_a_vessel_of_high_floor_is_cut_at_the_rim_of_one_around_it(monkeypatch, floor, n_cuts):
    view, vessel, rows = vessel_from_above(floor=floor)
    circle = (0.0, 0.0, 0.058)
    seams = [Seam(0.03, nested, circle, (0.0, 0.0, 0.04), 0.01) for nested in (True, False)]
    monkeypatch.setattr(stack_cuts, "find_seams", lambda *_: seams)
    cuts = StackCuts([view], rows, [PLANE], Namer((0.5, 0.45, 0.0, 0.0, 0.05))).worth_fitting(
        4, 7, vessel, 0.0
    )
    assert len(cuts) == n_cuts
    for parts in cuts:
        lower, upper = parts.rows[0]
        assert lower.mask.any() and upper.mask.any() and not (lower.mask & upper.mask).any()
