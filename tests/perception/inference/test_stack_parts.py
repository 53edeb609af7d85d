"""What no single shape explains is cut in two, and stays cut if both parts are explained."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.inference import stack_choice, stack_parts
from perception.inference.stack_parts import parts_inside, parts_of_two_colors, propose_parts, split_stacks
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
    weak = [cylinder(stack.lower, 5, 0.25), replace(cylinder(stack.higher, 6, 0.4), rests_on=5)]
    assert set(split(stack, rows, lambda *_: weak)) == {4}
    monkeypatch.setattr(stack_choice, "BEYOND_DOUBT", 0.0)
    assert split(stack, rows, lambda *_: weak) == {}


@pytest.mark.parametrize(("gap", "accepted"), [(0.026, True), (0.035, False)])
def test_what_is_apart_from_what_is_below_it_does_not_stand_on_it(stack, rows, monkeypatch, gap, accepted):
    for module in (stack_parts, stack_choice):
        monkeypatch.setattr(module, "unexplained", lambda points, shapes: 0.05 if len(shapes) < 2 else 0.0)
    lower, upper = cylinder(stack.lower, 5), cylinder(stack.higher, 6)
    T = upper.T_world_object.copy()
    T[2, 3] += gap
    raised = replace(upper, T_world_object=T)
    found = split(stack, rows, lambda *_: [lower, raised], [cylinder(stack.lower, 4)])
    assert bool(found) == accepted


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


@pytest.mark.parametrize(
    ("network", "category"), [((0.1, 0.0, 0.1, 0.7, 0.1), "can"), ((0.2, 0, 0.5, 0, 0.3), "mug")]
)
def test_the_pose_network_is_asked_what_the_class_network_does_not_know(stack, rows, network, category):
    """Nothing stands on a bottle: the lower part is none to the class network, and a mug to both."""

    class OnMugs(Namer):
        def posed(self, frame, plane, detections):
            poses = np.array([posed == ("mug", "upright") for posed in POSED_CLASSES] + [False], float)
            return [replace(d, pose_probabilities=poses) for d in detections]

    (parts, *_) = propose_parts(frames_of(stack), rows, 4, [PLANE], OnMugs(network), 9)
    assert {d.category for row in parts.rows for d in row if d.instance_id == 9} == {category}


def test_objects_of_two_colors_are_parts(stack, rows):
    """The lower one is red, the upper one blue; in one colour they are not parted."""
    namer = Namer()
    assert parts_of_two_colors(frames_of(stack), rows, 4, [PLANE], namer, 9) == []
    frames = []
    for view, upper in zip(stack.seen, stack.upper):
        rgb = np.where(upper[..., None], (30, 60, 200), (200, 40, 30)).astype(np.uint8)
        frames.append(replace(view.frame, rgb=rgb))
    (parts,) = parts_of_two_colors(frames, rows, 4, [PLANE], namer, 9)
    assert parts.ids == (9, 10)
    assert sorted(set(np.round(namer.bases, 2))) == [0.0, pytest.approx(stack.height, abs=0.02)]
    for row, upper in zip(parts.rows, stack.upper):
        (high,) = (d.mask for d in row if d.instance_id == 10)
        assert (high & upper).sum() > 0.95 * upper.sum() and (high & ~upper).sum() < 0.05 * upper.sum()
    for unsure in ([0.1, 0.1, 0.05, 0.05, 0.7], [0.1, 0.1, 0.05, 0.5, 0.25]):
        assert parts_of_two_colors(frames, rows, 4, [PLANE], Namer(unsure), 9, True) == []


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
    (parts,) = parts_of_two_colors(frames, rows, 4, [PLANE], KnowsTheUpper(), 9, True)
    below = [d for row in parts.rows for d in row if d.instance_id == 9]
    assert below and all(is_unclassified(d) for d in below)
    assert parts_of_two_colors(frames, rows, 4, [PLANE], KnowsTheUpper(), 9) == []


def test_parts_with_far_better_scores_replace_an_unusual_shape_that_explains_as_much(stack, rows):
    whole = cylinder(stack.lower, 4, 0.2)
    both = trimesh.util.concatenate(
        [trimesh.Trimesh(e.mesh_world.vertices, e.mesh_world.faces, process=False)
         for e in (cylinder(stack.lower, 0), cylinder(stack.higher, 0))]
    )  # fmt: skip
    mesh = TriangleMesh(np.asarray(both.vertices), np.asarray(both.faces))
    whole = replace(whole, mesh=mesh.transformed(np.linalg.inv(whole.T_world_object)))
    parts = [cylinder(stack.lower, 5, 0.6), cylinder(stack.higher, 6, 0.9)]
    assert set(split(stack, rows, lambda *_: parts, [whole])) == {4}
    assert split(stack, rows, lambda *_: parts, [replace(whole, score=0.4)]) == {}
    assert split(stack, rows, lambda *_: parts, [replace(whole, score=0.6)]) == {}


@pytest.mark.parametrize(
    ("raised", "score", "name", "are_two"),
    [
        (True, 0.95, "bowl", True),
        (False, 0.95, "bowl", False),  # the inside of a mug of two colours
        (True, 0.7, "bowl", False),
        (True, 0.95, "can", False),  # what is not named a vessel is not cut from one that explains all
    ],
)
def test_a_vessel_that_explains_all_may_be_two_of_different_colors(
    stack, rows, monkeypatch, raised, score, name, are_two
):
    for module in (stack_parts, stack_choice):
        monkeypatch.setattr(module, "unexplained", lambda points, shapes: 0.01)
    whole = replace(cylinder(stack.lower, 4, 0.97), category="mug", resting="upright")

    def part(number, id):
        row = [ObjectDetection(("mug", name)[number], 0.95, view.mask, instance_id=id) for view in stack.seen]
        return [[d] for d in row]

    both = [[*a, *b] for a, b in zip(part(0, 5), part(1, 6))]
    monkeypatch.setattr(stack_parts, "parts_of_two_colors", lambda *_: [stack_parts.Parts(both, (5, 6))])
    lower = replace(cylinder(stack.lower, 5, 0.95), category="mug", resting="upright")
    upper = cylinder(stack.higher if raised else stack.lower, 6, score)
    upper = replace(upper, category="bowl", resting="upright")
    assert bool(split(stack, rows, lambda *_: [lower, upper], [whole])) is are_two


def test_the_likeliest_cuts_are_fitted(stack, rows, monkeypatch):
    """Not the first ones: what the networks are surer of is more often right than the stronger seam."""

    def cut(p):
        marked = [[ObjectDetection("can", p, d.mask, instance_id=i) for i in (5, 6)] for (d,) in rows]
        return stack_parts.Parts(marked, (5, 6))

    cuts = [cut(p) for p in (0.4, 0.5, 0.9)]
    monkeypatch.setattr(stack_parts, "propose_parts", lambda *_: cuts)
    fitted = []

    def fit(parts, rests_on):
        fitted.append(parts[0][0].score)
        return []

    split(stack, rows, fit)
    assert fitted == [0.9, 0.5]


def vessel_from_above(holds):
    """A vessel of 0.06 m seen from above, with a cylinder of 0.025 m in it if it holds one."""
    v, u = np.mgrid[:160, :200]
    away = np.hypot(u - 99.5, v - 79.5) / 400.0  # of a pixel's ray from the axis at 1 m
    depth = np.full((160, 200), 0.6, np.float32)
    for radius, height in ((0.06, 0.05), (0.055, 0.004), *([(0.025, 0.035)] if holds else [])):
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
    (parts,) = parts_inside([view], rows, vessel, 4, [PLANE], Namer((0.0, 0.45, 0.0, 0.5, 0.05)), 7)
    lower, upper = parts.rows[0]
    assert (lower.instance_id, lower.category) == (7, "bowl")
    assert (upper.instance_id, upper.category) == (8, "can")
    inner = np.isclose(view.depth, 0.565)
    assert (upper.mask & inner).sum() > 0.9 * inner.sum()
    assert (upper.mask & ~inner).sum() < 0.05 * inner.sum()
    assert not (upper.mask & lower.mask).any() and ((upper.mask | lower.mask) == rows[0][0].mask).all()


def test_empty_upside_down_and_closed_objects_hold_nothing():
    view, vessel, rows = vessel_from_above(holds=False)
    assert parts_inside([view], rows, vessel, 4, [PLANE], Namer(), 7) == []
    view, vessel, rows = vessel_from_above(holds=True)
    for other in (None, replace(vessel, resting="upside-down"), replace(vessel, category="can")):
        assert parts_inside([view], rows, other, 4, [PLANE], Namer(), 7) == []
    unnamed = Namer((0.0, 0.0, 0.0, 0.0, 1.0))
    assert parts_inside([view], rows, vessel, 4, [PLANE], unnamed, 7) == []
