"""What no single shape explains is cut in two, and stays cut if both parts are explained."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.inference import stack_choice, stack_parts
from perception.inference.stack_cuts import Parts, StackCuts
from perception.inference.stack_parts import split_stacks
from perception.types import (
    ObjectDetection,
    ObjectEstimate,
    SupportPlane,
    TriangleMesh,
    unclassified,
)
from tests.perception.inference.namers import Namer

PLANE = SupportPlane()


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


def painted(stack):
    """The frames, with the upper part in red."""
    frames = []
    for frame, upper in zip(frames_of(stack), stack.upper):
        rgb = frame.rgb.copy()
        rgb[upper] = 200, 20, 20
        frames.append(replace(frame, rgb=rgb))
    return frames


def split(stack, rows, fit, estimates=(), namer=None, frames=None):
    known = {e.id: e for e in estimates}
    return split_stacks(frames or frames_of(stack), rows, known, [PLANE], namer or Namer(), fit)


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
    """Of a detected object, that is: both parts of what has no class must be likely."""
    weak = [cylinder(stack.lower, 5, 0.25), replace(cylinder(stack.higher, 6, 0.4), rests_on=5)]
    whole = [cylinder(stack.lower, 4, 0.6)]
    assert set(split(stack, rows, lambda *_: weak, whole, frames=painted(stack))) == {4}
    assert split(stack, rows, lambda *_: weak, frames=painted(stack)) == {}
    monkeypatch.setattr(stack_choice, "BEYOND_DOUBT", 0.0)
    assert split(stack, rows, lambda *_: weak, whole, frames=painted(stack)) == {}


@pytest.mark.parametrize(
    ("scores", "accepted"), [((0.25, 0.9), False), ((0.9, 0.45), False), ((0.55, 0.55), True)]
)
def test_parts_of_one_color_need_better_scores(stack, rows, scores, accepted):
    """A teapot and its lid are of one colour; so may two mugs be that are both seen well."""
    lower, upper = cylinder(stack.lower, 5, scores[0]), cylinder(stack.higher, 6, scores[1])
    pair, whole = [lower, replace(upper, rests_on=5)], [cylinder(stack.lower, 4, 0.6)]
    assert set(split(stack, rows, lambda *_: pair, whole)) == ({4} if accepted else set())
    assert set(split(stack, rows, lambda *_: pair, whole, frames=painted(stack))) == {4}


@pytest.mark.parametrize("uncertain", [(4,), ()])
def test_what_is_taken_for_a_thing_is_judged_as_such(stack, rows, monkeypatch, uncertain):
    asked = []
    monkeypatch.setattr(stack_parts, "are_two", lambda *args: asked.append(args[-1]) or False)
    pair = [cylinder(stack.lower, 5), cylinder(stack.higher, 6)]
    known = {4: cylinder(stack.lower, 4, 0.2)}
    split_stacks(frames_of(stack), rows, known, [PLANE], Namer(), lambda *_: pair, uncertain=uncertain)
    assert set(asked) == {4 in uncertain}


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
    monkeypatch.setattr(StackCuts, "between_colors", lambda *_: [Parts(both, (5, 6))])
    lower = replace(cylinder(stack.lower, 5, 0.95), category="mug", resting="upright")
    upper = cylinder(stack.higher if raised else stack.lower, 6, score)
    upper = replace(upper, category="bowl", resting="upright")
    assert bool(split(stack, rows, lambda *_: [lower, upper], [whole])) is are_two


def test_the_likeliest_cuts_are_fitted(stack, rows, monkeypatch):
    """Not the first ones: what the networks are surer of is more often right than the stronger seam."""

    def cut(p):
        marked = [[ObjectDetection("can", p, d.mask, instance_id=i) for i in (5, 6)] for (d,) in rows]
        return Parts(marked, (5, 6))

    cuts = [cut(p) for p in (0.4, 0.5, 0.9)]
    monkeypatch.setattr(StackCuts, "at_seams", lambda *_: cuts)
    fitted = []

    def fit(parts, rests_on):
        fitted.append(parts[0][0].score)
        return []

    split(stack, rows, fit)
    assert fitted == [0.9, 0.5]
