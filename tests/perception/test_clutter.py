"""Candidates of no class are kept where the evidence is clear; parts of stacks replace them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perception import clutter
from perception.clutter import UNCERTAIN, UPRIGHT_PIECE, reconstruct_clutter
from perception.inference import doubtful_shapes, selection
from perception.inference.acceptance import shipped_acceptance
from perception.inference.clear_evidence import PIECE_SCORE, POSED_SCORE, THINNEST, UNCLASSIFIED_SCORE
from perception.inference.reconstruct import ReconstructOptions
from perception.inference.selection import CONTINUED
from perception.obstacles import parts_of_things
from perception.obstacles.parts_of_things import CARRIES, CROSSED, HANDLELESS
from perception.obstacles.same_colour import SAME_COLOUR
from perception.types import (
    ObjectDetection,
    RejectedObject,
    SupportPlane,
    is_unclassified,
)
from tests.perception.bare_estimates import FRAME, MASK, found


class Scene:
    """One detected object, two candidates of no class, and a tall one; fits and splits are given."""

    def __init__(self, monkeypatch):
        self.detected, *self.candidates, self.tall = (
            ObjectDetection("can", 0.9, MASK, instance_id=i) for i in range(4)
        )
        self.n_frames = 1  # of which the first one shows everything
        self.scores = {0: UNCERTAIN + 0.01, 1: UNCLASSIFIED_SCORE + 0.01, 2: UNCLASSIFIED_SCORE - 0.01}
        self.poses = [9, 8, 7, 6]  # upright or lying cans and bottles, or no objects
        self.posed_ids: list[list[int]] = []
        self.stacks, self.fitted, self.rejected, self.nameless = {}, [], [], []
        monkeypatch.setattr(clutter, "associate_unclassified", lambda *args: self.unclassified())
        monkeypatch.setattr(clutter, "is_low", lambda frames, rows, id, plane: id != 3)
        monkeypatch.setattr(clutter, "reconstruct", self.reconstruct)
        monkeypatch.setattr(clutter, "split_stacks", self.split)
        self.pieces, self.halves, self.wholes, self.fragments = {}, {}, {}, set()
        self.agreed_on = {}  # estimates from masks on which the views agree
        monkeypatch.setattr(clutter, "parts_of_things", lambda *_: self.fragments)
        self.shares = {}  # of the outlines of candidates, in things
        monkeypatch.setattr(selection, "continued_shares", self.continued_shares)
        monkeypatch.setattr(clutter, "Recutting", lambda *_: self)
        monkeypatch.setattr(doubtful_shapes, "with_lost_parts", lambda *_: {})
        monkeypatch.setattr(doubtful_shapes, "with_lost_ends", lambda *_: {})
        monkeypatch.setattr(doubtful_shapes, "without_stray_parts", lambda frames, rows, *_: rows)
        for module in (doubtful_shapes, selection):
            monkeypatch.setattr(module, "instance_points", lambda frames, rows, id: self.points(id))
            monkeypatch.setattr(module, "unexplained", self.unexplained)
        self.carriers = set()
        monkeypatch.setattr(parts_of_things, "carriers_of_parts", lambda *_: set(self.carriers))
        self.handleless = set()
        monkeypatch.setattr(parts_of_things, "mugs_without_handle", lambda *_: set(self.handleless))
        self.continued = set()
        monkeypatch.setattr(parts_of_things, "continued_in_colour", lambda *_: set(self.continued))
        self.crossed = set()
        monkeypatch.setattr(parts_of_things, "crossed", lambda *_: set(self.crossed))
        self.inside = {}  # share of the volume of one estimate in another
        monkeypatch.setattr(selection, "shared_volume", lambda a, b: self.inside.get((a.id, b.id), 0.0))
        self.explained = {(id, id) for id in range(4)}  # (points, estimate)

    def unclassified(self):
        return [[*self.candidates, self.tall], *([] for _ in range(self.n_frames - 1))]

    def reconstruct(self, frames, rows, decoder, planes, options):
        self.fitted.append([d.instance_id for row in rows for d in row])
        bare = {d.instance_id for row in rows for d in row if is_unclassified(d)}
        self.posed_ids.append([int(d.pose_probabilities.argmax()) for row in rows for d in row])
        self.nameless += [bare] if bare else []
        if options.on_rejected is not None:
            for id in range(4):
                options.on_rejected(RejectedObject(id, "mug", "thin", 0.1))
        return [found(id, self.scores[id]) for id in self.fitted[-1] if id in self.scores]

    def complete(self, frame, plane, detections):
        raise AssertionError("all classes are given")

    def posed(self, frame, plane, detections):
        return [replace(d, pose_probabilities=np.eye(10)[self.poses[d.instance_id or 0]]) for d in detections]

    def points(self, id):
        return np.full((1, 3), float(id))

    def unexplained(self, points, shapes):
        return 0.0 if any((int(points[0, 0]), shape.id) in self.explained for shape in shapes) else 1.0

    def split(self, frames, rows, estimates, planes, completer, fit, workers, uncertain):
        self.uncertain = set(uncertain)
        self.known, self.rows = sorted(estimates), [[d.instance_id for d in row] for row in rows]
        return self.stacks

    def agreed(self, rows, ids, is_kept):
        self.unexplained_ids = set(ids)
        return rows, {e.id: e for e in self.agreed_on.values() if e.id in ids and is_kept(e)}

    def separated(self, rows, ids, first_id):
        self.lost, self.first_id = ids, first_id
        return self.recut(rows, self.pieces, ids), {e.id: e for e in self.pieces.values()}

    def parted(self, rows, ids, first_id, is_kept):
        self.left = set(ids)
        assert first_id > max(clutter.instance_ids(rows))
        return self.recut(rows, self.halves, ids), {e.id: e for e in self.halves.values() if is_kept(e, rows)}

    def joined(self, rows, ids, estimates, first_id):
        self.nameless_ids, self.known_before = ids, sorted(estimates)
        assert first_id > max(clutter.instance_ids(rows))
        return self.recut(rows, self.wholes, ids), {e.id: e for e in self.wholes.values()}

    def continued_shares(self, frames, rows, things):
        self.doubtful, self.things = clutter.instance_ids(rows), [len(masks) for masks in things]
        return self.shares

    def recut(self, rows, found, gone):
        """Rows with instances in place of all others, if there are any."""
        if not found:
            return rows
        new = [ObjectDetection("can", 0.9, MASK, instance_id=id) for id in found]
        return [[*(d for d in row if d.instance_id not in gone), *new] for row in rows]

    def run(self):
        run: Any = getattr(reconstruct_clutter, "__wrapped__", reconstruct_clutter)
        options = ReconstructOptions(on_rejected=self.rejected.append)
        frames, empty = (FRAME,) * self.n_frames, ((),) * (self.n_frames - 1)
        estimates = run(frames, ((self.detected,), *empty), (), None, (SupportPlane(),), self, options)
        return [e.id for e in estimates]


@pytest.fixture
def scene(monkeypatch):
    return Scene(monkeypatch)


def test_candidates_are_objects_only_if_the_evidence_is_clear(scene):
    assert scene.run() == [0, 1]
    assert scene.fitted == [[0, 1, 2]], "a tall thing neither lies nor stands on its rim"
    assert [item.id for item in scene.rejected] == [0], "nobody misses what was no object before"


@pytest.mark.parametrize("beyond", [-0.01, 0.01])
def test_what_no_shape_explains_may_be_an_object_where_the_views_agree(scene, beyond):
    """It is not cut in pieces then."""
    scene.agreed_on = {2: found(2, UNCLASSIFIED_SCORE + beyond)}
    assert scene.run() == ([0, 1, 2] if beyond > 0 else [0, 1])
    assert scene.unexplained_ids == {2, 3}
    assert scene.lost == ({3} if beyond > 0 else {2, 3})


@pytest.mark.parametrize("beyond", [-0.01, 0.01])
def test_a_named_object_is_not_left_out_where_the_views_agree_on_less(scene, beyond):
    """Masks of several views may have a part of its neighbour."""
    scene.n_frames = 2
    scene.scores[0] = UNCERTAIN - 0.1
    scene.agreed_on = {0: found(0, UNCERTAIN + beyond)}
    assert scene.run() == ([0, 1] if beyond > 0 else [1])
    assert scene.unexplained_ids == {0, 2, 3}
    scene.scores[0] = UNCERTAIN + 0.1
    assert scene.run() == [0, 1] and scene.unexplained_ids == {2, 3}, "only what is doubtful"


def test_pieces_of_what_no_shape_explains_need_a_high_score(scene, monkeypatch):
    """They lie or stand upright, and show their ends."""
    poses = {4: (PIECE_SCORE - 0.01, "lying"), 5: (PIECE_SCORE + 0.01, "lying"), 6: (0.99, "upside-down")}
    poses |= {7: (0.98, "lying"), 8: (UPRIGHT_PIECE + 0.01, "upright"), 9: (UPRIGHT_PIECE - 0.01, "upright")}
    monkeypatch.setattr(clutter, "shows_ends", lambda estimate, points: estimate.id != 7)
    scene.pieces = {id: found(id, score, resting=resting) for id, (score, resting) in poses.items()}
    assert scene.run() == [0, 1, 5, 8]
    assert scene.lost == {2, 3}, "the tall thing as well"
    assert scene.first_id == 4 and scene.nameless_ids >= {1, *range(4, 10)}
    assert scene.known_before == [0, 1, 5, 8]


def test_what_no_shape_explains_may_be_two_things_of_different_colours(scene, monkeypatch):
    """They are parted before what remains is cut at creases, which may leave a handle without its mug."""
    monkeypatch.setattr(clutter, "shows_ends", lambda estimate, points: True)
    scene.halves = {4: found(4, PIECE_SCORE + 0.01, resting="lying"), 5: found(5, 0.5, resting="lying")}
    assert scene.run() == [0, 1, 4]
    assert scene.left == {2, 3} and scene.lost == set()
    assert scene.first_id > 5 and scene.nameless_ids >= {1, 4, 5} and scene.known_before == [0, 1, 4]


@pytest.mark.parametrize(("beyond", "expected"), [(-0.01, {0}), (0.01, set())])
def test_a_stack_may_replace_what_is_taken_for_a_thing(scene, beyond, expected):
    scene.scores[0], scene.n_frames = UNCERTAIN + beyond, 2
    scene.run()
    assert scene.uncertain == expected


def test_a_part_of_a_thing_is_no_object_but_occludes_others(scene):
    scene.fragments = {0}
    assert scene.run() == [1]
    assert scene.fitted == [[None, 1, 2]]
    assert [(item.id, item.reason) for item in scene.rejected][:1] == [
        (0, "its surface goes on in a thing of no class")
    ]


@pytest.mark.parametrize(("share", "score", "kept"), [
    (CONTINUED - 0.01, PIECE_SCORE - 0.01, True), (CONTINUED + 0.01, PIECE_SCORE - 0.01, False),
    (CONTINUED + 0.01, PIECE_SCORE + 0.01, True),
])  # fmt: skip
def test_a_doubtful_candidate_that_goes_on_in_a_thing_is_a_part_of_it(scene, share, score, kept):
    scene.scores[1] = score
    scene.shares = {1: [0.0, share, 1.0]} if score < PIECE_SCORE else {}
    assert scene.run() == ([0, 1] if kept else [0])
    if score < PIECE_SCORE:
        assert scene.doubtful == {1} and scene.things == [2], "what was rejected, and what is too tall"


def test_a_lying_bottle_that_is_thinner_than_bottles_is_a_handle(scene):
    thin, thick = (
        found(id, 0.99, "bottle", "lying", radius=THINNEST + more) for id, more in ((4, -0.001), (5, 0.001))
    )
    scene.pieces = {4: thin, 5: thick}
    assert scene.run() == [0, 1, 5]


def test_what_carries_a_part_of_no_class_is_part_of_a_thing(scene):
    scene.carriers = {0}
    assert scene.run() == [1]
    assert [(item.id, item.reason) for item in scene.rejected][-1] == (0, CARRIES)
    scene.carriers = {1}
    assert scene.run() == [0], "a candidate is left out without a report"
    assert scene.rejected[-1].id == 0


def test_a_mug_without_a_handle_is_part_of_a_thing(scene):
    scene.handleless, scene.stacks = {0, 7}, {3: (found(7), found(8))}
    assert scene.run() == [1]
    assert [(item.id, item.reason) for item in scene.rejected][-1] == (0, HANDLELESS)


def test_what_goes_on_in_its_own_colour_is_part_of_a_thing(scene):
    scene.continued = {0}
    assert scene.run() == [1]
    assert [(item.id, item.reason) for item in scene.rejected][-1] == (0, SAME_COLOUR)


def test_what_something_goes_through_is_part_of_a_thing(scene):
    scene.crossed = {0}
    assert scene.run() == [1]
    assert [(item.id, item.reason) for item in scene.rejected][-1] == (0, CROSSED)


def test_a_stack_of_which_a_part_carries_something_is_left_out_as_a_whole(scene):
    scene.stacks = {0: (found(5), found(6)), 3: (found(7), found(8))}
    scene.carriers = {5}
    assert scene.run() == [1, 7, 8]
    assert scene.rejected == []


def test_what_is_joined_replaces_its_parts(scene):
    scene.wholes = {4: found(4)}
    assert scene.run() == [0, 4]


def test_what_several_views_leave_doubtful_is_reported_as_a_thing_of_no_class(scene):
    """Also where one of them alone shows it."""
    scene.scores[0], scene.n_frames = UNCERTAIN - 0.01, 2
    assert scene.run() == [1]
    assert [item.reason for item in scene.rejected if item.id == 0][-1] == (
        "score 0.39 over all views: it is taken for a thing of no class"
    )


@pytest.mark.parametrize(("can", "resting", "exists"), [
    (0.62, "upright", True), (0.05, "upright", False), (0.62, "lying", False),
])  # fmt: skip
def test_what_may_be_a_bottle_or_a_can_is_no_thing_of_no_class(can, resting, exists):
    p = np.array([0.0, 0.0, 0.38, can, 0.62 - can])
    rows = [[ObjectDetection("can", 0.6, MASK, instance_id=0, class_probabilities=p)]]
    estimate = found(0, 0.2, "bottle", resting)
    assert (clutter._existence(estimate, rows, shipped_acceptance()) > UNCERTAIN) == exists
    assert clutter._existence(estimate, rows, None) == 0.2
    assert clutter._existence(estimate, [[]], shipped_acceptance()) == 0.2


def test_a_single_image_is_judged_by_the_acceptance_model_alone(scene, monkeypatch):
    monkeypatch.setattr(clutter, "reconstruct", lambda *args, **options: [found(0, UNCERTAIN - 0.1)])
    assert scene.run() == [0]


def test_candidates_that_do_not_stand_need_a_higher_score(scene, monkeypatch):
    lying = {1: POSED_SCORE - 0.01, 2: POSED_SCORE + 0.01}
    monkeypatch.setattr(
        clutter,
        "reconstruct",
        lambda *args, **options: [found(id, p, "can", "lying") for id, p in lying.items()],
    )
    assert scene.run() == [2]


def test_all_candidates_may_be_stacks(scene):
    scene.run()
    assert scene.known == [0, 1] and scene.rows == [[0, 1, 2, 3]]


def test_parts_replace_their_whole(scene):
    scene.stacks = {0: (found(5), found(6)), 3: (found(7), found(8))}
    assert scene.run() == [1, 5, 6, 7, 8]
    assert scene.rejected == []


@pytest.mark.parametrize(("views", "kept"), [(2, [1, 5, 6]), (4, [1, 7, 8])])
def test_a_stack_that_was_associated_as_two_instances_is_one(scene, views, kept):
    """That of more views is kept."""
    scene.stacks = {0: (found(5, n_views=3), found(6)), 3: (found(7, n_views=views), found(8))}
    scene.explained |= {(3, 5), (0, 8)}
    assert scene.run() == kept


def test_an_object_that_a_part_of_a_stack_explains_is_that_part(scene):
    scene.stacks = {3: (found(7), found(8))}
    assert scene.run() == [0, 1, 7, 8]
    scene.explained.add((0, 8))
    assert scene.run() == [1, 7, 8]
    scene.explained.add((1, 7))
    assert scene.run() == [7, 8]


def test_a_candidate_that_another_object_explains_is_part_of_it(scene):
    scene.explained.add((1, 0))
    assert scene.run() == [0]


@pytest.mark.parametrize(("share", "kept"), [(0.3, [0, 1]), (0.4, [0])])
def test_a_candidate_inside_another_object_is_part_of_it(scene, share, kept):
    scene.inside[1, 0] = share
    assert scene.run() == kept


def test_a_detected_object_that_its_class_does_not_explain_is_fitted_without_one(scene):
    scene.explained -= {(0, 0)}
    scene.scores[0] = 0.9
    scene.run()
    assert scene.fitted == [[0, 1, 2], [0]] and scene.nameless == [{0}]


def test_what_is_fitted_has_its_pose_probabilities(scene):
    scene.explained -= {(0, 0)}
    scene.scores[0] = 0.9
    scene.run()
    assert scene.posed_ids == [[9, 8, 7], [9]]
