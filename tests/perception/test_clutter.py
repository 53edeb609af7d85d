"""Candidates of no class are kept where the evidence is clear; parts of stacks replace them."""

import numpy as np
import pytest

from perception import clutter
from perception.clutter import UNCLASSIFIED_SCORE, reconstruct_clutter
from perception.inference.reconstruct import ReconstructOptions
from perception.types import ObjectDetection, ObjectEstimate, RejectedObject, SupportPlane

MASK = np.ones((4, 4), np.bool_)


def found(id, score=0.9):
    made = object.__new__(ObjectEstimate)
    vars(made).update(id=id, score=score)
    return made


class Scene:
    """One detected object, two candidates of no class, and a tall one; fits and splits are given."""

    def __init__(self, monkeypatch):
        self.detected, *self.candidates, self.tall = (
            ObjectDetection("can", 0.9, MASK, instance_id=i) for i in range(4)
        )
        self.scores = {0: 0.1, 1: UNCLASSIFIED_SCORE + 0.01, 2: UNCLASSIFIED_SCORE - 0.01}
        self.stacks, self.fitted, self.rejected = {}, [], []
        monkeypatch.setattr(clutter, "associate_unclassified", lambda *args: [[*self.candidates, self.tall]])
        monkeypatch.setattr(clutter, "is_low", lambda frames, rows, id, plane: id != 3)
        monkeypatch.setattr(clutter, "reconstruct", self.reconstruct)
        monkeypatch.setattr(clutter, "split_stacks", self.split)

    def reconstruct(self, frames, rows, decoder, planes, options):
        self.fitted.append([d.instance_id for row in rows for d in row])
        if options.on_rejected is not None:
            for id in range(4):
                options.on_rejected(RejectedObject(id, "mug", "thin", 0.1))
        return [found(id, self.scores[id]) for id in self.fitted[-1] if id in self.scores]

    def split(self, frames, rows, estimates, planes, completer, fit):
        self.known, self.rows = sorted(estimates), [[d.instance_id for d in row] for row in rows]
        return self.stacks

    def run(self):
        run = getattr(reconstruct_clutter, "__wrapped__", reconstruct_clutter)
        options = ReconstructOptions(on_rejected=self.rejected.append)
        estimates = run((), ((self.detected,),), (), None, (SupportPlane(),), None, options)
        return [e.id for e in estimates]


@pytest.fixture
def scene(monkeypatch):
    return Scene(monkeypatch)


def test_candidates_are_objects_only_if_the_evidence_is_clear(scene):
    assert scene.run() == [0, 1]
    assert scene.fitted == [[0, 1, 2]], "a tall thing neither lies nor stands on its rim"
    assert [item.id for item in scene.rejected] == [0], "nobody misses what was no object before"


def test_all_candidates_may_be_stacks(scene):
    scene.run()
    assert scene.known == [0, 1] and scene.rows == [[0, 1, 2, 3]]


def test_parts_replace_their_whole(scene):
    scene.stacks = {0: (found(5), found(6)), 3: (found(7), found(8))}
    assert scene.run() == [1, 5, 6, 7, 8]
    assert scene.rejected == []
