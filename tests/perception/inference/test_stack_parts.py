"""What no single shape explains is cut in two, and stays cut if both parts are explained."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.inference import stack_parts
from perception.inference.stack_parts import propose_parts, split_stacks, unexplained
from perception.types import ObjectDetection, ObjectEstimate, SupportPlane, TriangleMesh, unclassified

PLANE = SupportPlane()


class Namer:
    """Names every mask a can, or something else, and keeps what it stood on."""

    def __init__(self, probabilities=(0.1, 0.0, 0.1, 0.7, 0.1)):
        self.probabilities, self.bases = np.array(probabilities), []

    def complete(self, frame, plane, detections):
        self.bases.append(plane.offset)
        return [replace(d, class_probabilities=self.probabilities) for d in detections]

    def posed(self, frame, plane, detections):
        return [replace(d, pose_probabilities=np.full(10, 0.1)) for d in detections]


def cylinder(table, id, score=0.9):
    """The estimate of a can on its table, at its true pose."""
    code, scale = table.code, float(table.pose.scale[0])
    shape = trimesh.creation.cylinder(
        scale * (0.55 + 0.08 * code[0]), 2 * scale * (0.75 + 0.08 * code[1]), sections=48
    )
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    pose = table.pose.T_world_object
    return ObjectEstimate(id, "can", np.zeros(16), pose, np.full(3, scale), mesh, score)


@pytest.fixture
def rows(stack):
    return [[unclassified(view.mask, 4)] for view in stack.seen]


def frames_of(stack):
    return [view.frame for view in stack.seen]


def split(stack, rows, fit, estimates=(), namer=None):
    known = {e.id: e for e in estimates}
    return split_stacks(frames_of(stack), rows, known, [PLANE], namer or Namer(), fit)


def test_both_parts_replace_the_whole(stack, rows):
    def fit(parts, rests_on):
        assert rests_on == {6: 5}
        assert [{d.instance_id for d in row} for row in parts] == [{5, 6}] * 3
        for row, upper in zip(parts, stack.upper):
            (high,) = (d.mask for d in row if d.instance_id == 6)
            assert (high & upper).sum() > 0.9 * upper.sum()
        return [cylinder(stack.lower, 5), cylinder(stack.higher, 6)]

    found = split(stack, rows, fit)
    assert {id: [e.id for e in pair] for id, pair in found.items()} == {4: [5, 6]}


def test_parts_that_are_not_accepted_leave_the_whole(stack, rows):
    good, bad = cylinder(stack.lower, 5, 0.25), cylinder(stack.higher, 6, 0.05)
    misplaced = cylinder(stack.lower, 6)  # explains nothing of the upper part
    for parts in (
        [good],
        [good, bad],
        [good, misplaced],
        [good, replace(cylinder(stack.higher, 6), status="implausible")],
    ):
        assert split(stack, rows, lambda *_, parts=parts: parts) == {}


def test_weak_scores_suffice_for_parts_that_explain_nearly_all(stack, rows, monkeypatch):
    weak = [cylinder(stack.lower, 5, 0.25), cylinder(stack.higher, 6, 0.4)]
    assert set(split(stack, rows, lambda *_: weak)) == {4}
    monkeypatch.setattr(stack_parts, "BEYOND_DOUBT", 0.0)
    assert split(stack, rows, lambda *_: weak) == {}


def test_what_one_shape_explains_is_not_cut(stack):
    single = [[ObjectDetection("can", 0.9, view.mask & ~upper, instance_id=2)]
              for view, upper in zip(stack.seen, stack.upper)]  # fmt: skip
    namer = Namer()
    assert split(stack, single, lambda *_: pytest.fail("fitted"), [cylinder(stack.lower, 2)], namer) == {}
    assert namer.bases == []


def test_the_upper_part_is_named_on_the_seam_and_parts_without_a_class_are_none(stack, rows):
    namer = Namer()
    (parts, *_) = propose_parts(frames_of(stack), rows, 4, [PLANE], namer, 9)
    assert parts.ids == (9, 10)
    assert sorted(set(np.round(namer.bases[:6], 2))) == [0.0, pytest.approx(stack.height, abs=0.01)]
    assert {d.category for row in parts.rows for d in row} == {"can"}
    thing = Namer([0.1, 0.1, 0.05, 0.05, 0.7])
    assert propose_parts(frames_of(stack), rows, 4, [PLANE], thing, 9) == []


def test_the_unexplained_share_counts_points_far_from_all_surfaces(stack):
    can = cylinder(stack.lower, 0)
    on_it = can.mesh_world.vertices
    above = on_it + np.array([0.0, 0.0, 0.2])
    assert unexplained(on_it, [can]) == 0.0
    assert unexplained(np.concatenate([on_it, above]), [can]) == pytest.approx(0.5)
    assert unexplained(on_it + np.array([0.0, 0.0, stack_parts.FAR / 2]), [can]) == 0.0
    assert unexplained(on_it, []) == 1.0
