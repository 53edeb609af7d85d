"""Which classes are fitted, and which is kept, for given scores."""

from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest

from perception.errors import PerceptionError
from perception.inference import pose_choice, resting_choice, scored_fits
from perception.inference.acceptance import AcceptanceModel
from perception.inference.class_choice import LONGER, fit_best_class
from perception.inference.evidence import Evidence
from perception.inference.fit import FitFailedError
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.inference.scored_fits import RejectedError, ScoredFit
from perception.types import (
    CATEGORIES,
    POSED_CLASSES,
    CameraIntrinsics,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
)

EVIDENCE = replace(Evidence(*[0.5] * len(fields(Evidence))), explained=1.0, free_space=0.0, converged=1.0)


CAMERA = CameraIntrinsics(2, 2, 1.0, 1.0, 0.0, 0.0)
FRAME = RgbdFrame(0.0, np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), np.float32), CAMERA, np.eye(4))
OBSERVATION = ObjectObservation(FRAME, np.ones((2, 2), bool))


class Model(AcceptanceModel):
    def reason(self, evidence, category, class_probability=None, count=2):
        return "it floats"


@pytest.fixture
def choose(monkeypatch, decoder):
    """A function from scores and class probabilities to the choice, and the classes that it tried."""
    tried = []

    def run(scores, probabilities, category="mug", seen=1):
        tried.clear()

        def scored(views, decoder, plane, model, config, on_step):
            tried.append(views.category)
            score = scores[views.category]
            if isinstance(score, Exception):
                raise score
            p = views.class_probabilities
            known = float(p[CATEGORIES.index(views.category)]) if p.size else None
            mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
            estimate = ObjectEstimate(3, views.category, np.zeros(16), np.eye(4), np.ones(3), mesh, score)
            return ScoredFit(estimate, EVIDENCE, known)

        monkeypatch.setattr(scored_fits, "scored_fit", scored)
        monkeypatch.setattr(resting_choice, "comes_near", lambda *_: True)
        monkeypatch.setattr(resting_choice, "nearest_hypotheses", lambda *_: POSED_CLASSES)
        monkeypatch.setattr(pose_choice, "rests_stably", lambda mesh, plane: True)
        views = ObjectViews(3, category, 0.9, (OBSERVATION,) * seen, np.array(probabilities))
        return fit_best_class(views, decoder, SupportPlane(), Model({}, 0.4), FitConfig())

    return run, tried


def test_a_clear_object_is_fitted_once(choose) -> None:
    run, tried = choose
    estimate = run({"mug": 0.95}, [0.95, 0.02, 0.01, 0.01, 0.01])
    assert (estimate.category, estimate.score, tried) == ("mug", 0.95, ["mug"])


def test_a_doubtful_class_is_compared_with_the_next_ones(choose) -> None:
    run, tried = choose
    estimate = run({"mug": 0.6, "can": 0.8, "bottle": 0.1}, [0.5, 0.0, 0.1, 0.3, 0.1])
    assert (estimate.category, tried) == ("can", ["mug", "can", "bottle"])


def test_weak_evidence_is_compared_although_the_detector_is_sure(choose) -> None:
    run, tried = choose
    estimate = run({"mug": 0.2, "bowl": 0.7}, [0.95, 0.03, 0.01, 0.0, 0.01])
    assert (estimate.category, tried) == ("bowl", ["mug", "bowl"])


@pytest.mark.parametrize(
    ("first", "longer", "seen", "is_detected", "iterations", "score"),
    [
        ((0.3, "not_converged"), 0.7, 2, True, [30, 30 * LONGER], 0.7),
        ((0.3, "not_converged"), 0.2, 2, True, [30, 30 * LONGER], 0.3),
        ((0.3, "converged"), 0.7, 2, True, [30], 0.3),
        ((0.6, "not_converged"), 0.7, 2, True, [30], 0.6),
        ((0.3, "not_converged"), 0.7, 1, True, [30], None),
        ((0.3, "not_converged"), 0.7, 2, False, [30], 0.3),
    ],
)
def test_a_poor_fit_to_several_views_that_has_not_converged_is_made_again(
    monkeypatch, decoder, first, longer, seen, is_detected, iterations, score
) -> None:
    """Of an object that the detector named: the parts of what may be a stack are many."""
    done = []

    def scored(views, decoder, plane, model, config, on_step):
        if views.category != "mug":
            raise PerceptionError("no")
        done.append(sum(stage.iterations for stage in config.stages))
        value, status = first if len(done) == 1 else (longer, "converged")
        mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
        made = ObjectEstimate(3, "mug", np.zeros(16), np.eye(4), np.ones(3), mesh, value, status=status)
        return ScoredFit(made, EVIDENCE, 0.9)

    monkeypatch.setattr(scored_fits, "scored_fit", scored)
    monkeypatch.setattr(resting_choice, "comes_near", lambda *_: False)
    p = np.array([0.96, 0.01, 0.01, 0.01, 0.01])
    views = ObjectViews(3, "mug", 0.9, (OBSERVATION,) * seen, p)
    call = partial(fit_best_class, views, decoder, SupportPlane(), Model({}, 0.4), FitConfig())
    if score is None:
        with pytest.raises(RejectedError):
            call(is_detected=is_detected)
    else:
        assert call(is_detected=is_detected).score == score
    assert done[: len(iterations)] == iterations and (len(done) == len(iterations) or seen == 1)


def test_an_object_of_no_class_is_rejected_with_its_best_score(choose) -> None:
    run, _ = choose
    with pytest.raises(RejectedError, match=r"^score 0\.30: it floats$") as caught:
        run({"mug": 0.2, "can": 0.3}, [0.5, 0.0, 0.0, 0.4, 0.1])
    assert (caught.value.category, caught.value.score) == ("can", 0.3)


def test_an_object_confirmed_by_a_second_view_is_not_rejected(choose) -> None:
    run, tried = choose
    estimate = run({"mug": 0.2, "can": 0.3}, [0.5, 0.0, 0.0, 0.4, 0.1], seen=2)
    assert (estimate.category, estimate.score, tried) == ("can", 0.3, ["mug", "can"])


def test_an_object_of_no_class_is_rejected_even_if_seen_twice(choose) -> None:
    run, tried = choose
    with pytest.raises(RejectedError):
        run({"mug": 0.2, "can": 0.45, "bowl": 0.1, "bottle": 0.1}, [0.2] * 5, seen=2)
    assert set(tried) == set(CATEGORIES)


def test_a_given_class_is_kept(choose) -> None:
    run, tried = choose
    estimate = run({"mug": 0.1}, [])
    assert (estimate.category, estimate.score, tried) == ("mug", 0.1, ["mug"])


def test_a_fit_that_fails_leaves_the_other_classes(choose) -> None:
    run, _ = choose
    failure = FitFailedError("the fit failed")
    assert run({"mug": failure, "can": 0.8}, [0.95, 0.0, 0.0, 0.03, 0.02]).category == "can"
    with pytest.raises(FitFailedError, match="the fit failed"):
        run({"mug": failure}, [0.99, 0.0, 0.0, 0.0, 0.01])
    with pytest.raises(PerceptionError, match="the fit failed"):
        run({"mug": failure}, [])


def test_scores_are_those_of_the_evidence(make_table, decoder) -> None:
    """For real: the score is the model's, and the same object as a detection of known class."""
    table = make_table("can", (1.0, 0.5), yaw=0.0)
    views = ObjectViews(0, "can", 0.2, tuple(table.observations((0.0,))))
    model = AcceptanceModel.load()
    estimate = fit_best_class(views, decoder, SupportPlane(), model)
    assert 0 < estimate.score < 1 and estimate.score != 0.2
    known = replace(views, class_probabilities=np.array([0.01, 0.0, 0.0, 0.98, 0.01]))
    assert fit_best_class(known, decoder, SupportPlane(), model).score != estimate.score


def test_the_pose_network_counts_where_the_class_network_gave_no_class(make_table, decoder) -> None:
    """An orange is as round as a can: what names it none decides."""
    table = make_table("can", (1.0, 0.5), yaw=0.0)
    views = ObjectViews(0, "can", 0.2, tuple(table.observations((0.0,))), np.full(5, 0.2))
    model = AcceptanceModel.load()

    def choose_with(poses: dict[tuple[str, str] | None, float]) -> ObjectEstimate:
        p = np.array([poses.get(posed, 0.0) for posed in (*POSED_CLASSES, None)])
        return fit_best_class(replace(views, pose_probabilities=p), decoder, SupportPlane(), model)

    doubtful = choose_with({("can", "upright"): 0.4, None: 0.6})
    sure = choose_with({("can", "upright"): 0.9, None: 0.1})
    assert doubtful.resting == sure.resting == "upright" and doubtful.score < sure.score
    with pytest.raises(RejectedError):
        choose_with({("can", "upright"): 0.01, None: 0.99})


@pytest.fixture
def choose_pose(monkeypatch, decoder):
    """A function from the shares explained in each pose to the choice, and the poses that it tried."""
    tried = []

    def run(
        explained, probabilities=(), resting_stably=True, near=True, hypotheses=POSED_CLASSES, named=None
    ):
        tried.clear()

        def scored(views, decoder, plane, model, config, on_step):
            tried.append((views.category, config.resting))
            share = explained.get((views.category, config.resting), 0.3)
            mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
            estimate = ObjectEstimate(
                3, views.category, np.zeros(16), np.eye(4), np.ones(3), mesh, 0.8, resting=config.resting
            )
            return ScoredFit(estimate, replace(EVIDENCE, explained=share), None)

        monkeypatch.setattr(scored_fits, "scored_fit", scored)
        monkeypatch.setattr(resting_choice, "is_stubby", lambda _: False)
        monkeypatch.setattr(resting_choice, "comes_near", lambda *_: near)
        monkeypatch.setattr(resting_choice, "nearest_hypotheses", lambda *_: hypotheses)
        monkeypatch.setattr(pose_choice, "rests_stably", lambda mesh, plane: resting_stably)
        named = named if isinstance(named, dict) else {} if named is None else {named: 1.0}
        posed = np.array([named.get(h, 0.0) for h in POSED_CLASSES] + [0.0]) if named else np.zeros(0)
        views = ObjectViews(3, "bottle", 0.9, (OBSERVATION,), np.array(probabilities), posed)
        return fit_best_class(views, decoder, SupportPlane(), Model({}, 0.4), FitConfig())

    return run, tried


def test_an_upright_object_is_fitted_in_no_other_pose(choose_pose) -> None:
    run, tried = choose_pose
    assert run({("bottle", "upright"): 0.95}).resting == "upright"
    assert tried == [("bottle", "upright")]


def test_an_object_of_given_class_that_does_not_stand_is_tried_in_its_other_poses(choose_pose) -> None:
    run, tried = choose_pose
    assert run({("bottle", "upright"): 0.6, ("bottle", "lying"): 0.96}).resting == "lying"
    assert tried == [("bottle", "upright"), ("bottle", "lying"), ("bottle", "lying")]  # both ways round
    assert (
        run({("bottle", "upright"): 0.6, ("bottle", "lying"): 0.77}).resting == "upright"
    )  # neither is good
    assert run({("bottle", "upright"): 0.6, ("bottle", "lying"): 0.96}, (), False).resting == "upright"


def test_poses_that_do_not_come_near_are_not_fitted(choose_pose) -> None:
    run, tried = choose_pose
    assert run({("bottle", "upright"): 0.6, ("bottle", "lying"): 0.96}, near=False).resting == "upright"
    assert tried == [("bottle", "upright")]


def test_an_object_of_no_class_is_fitted_as_what_comes_near(choose_pose) -> None:
    run, tried = choose_pose
    near = [("mug", "upside-down"), ("can", "lying")]
    estimate = run({near[0]: 0.95, near[1]: 0.8}, np.full(5, 0.2), hypotheses=near)
    assert (estimate.category, estimate.resting, tried) == ("mug", "upside-down", near)
    with pytest.raises(RejectedError, match="no shape in any resting pose"):
        run({near[0]: 0.7, near[1]: 0.8}, np.full(5, 0.2), hypotheses=near)
    with pytest.raises(RejectedError):
        run({near[0]: 0.95}, np.full(5, 0.2), resting_stably=False, hypotheses=near)


def test_only_the_poses_of_the_class_are_tried_where_the_detector_knows_one(choose_pose) -> None:
    """However well a mug upside down would explain it."""
    run, tried = choose_pose
    run({("bottle", "upright"): 0.5, ("mug", "upside-down"): 1.0}, [0.01, 0.0, 0.99, 0.0, 0.0])
    assert tried == [("bottle", "upright"), ("bottle", "lying")]


def test_a_class_that_the_evidence_contradicts_gives_way_to_one_that_explains_the_depth(choose_pose) -> None:
    run, tried = choose_pose
    sure = [0.0, 0.0, 0.95, 0.05, 0.0]
    assert run({("bottle", "upright"): 0.5, ("can", "upright"): 0.95}, sure).category == "can"
    assert tried == [("bottle", "upright"), ("can", "upright")]
    assert run({("bottle", "upright"): 0.6, ("can", "upright"): 0.95}, sure).category == "bottle"  # doubtful
    run({("bottle", "upright"): 0.5, ("can", "upright"): 0.6, ("bottle", "lying"): 0.96}, sure)
    assert tried[-1] == ("bottle", "lying")  # neither class stands: the poses of the first one


MUG = ("mug", "upside-down")


@pytest.mark.parametrize(("explained", "kept"), [(0.92, True), (0.89, False)])
def test_a_pose_that_is_named_for_sure_is_kept_if_depth_does_not_speak_against_it(
    choose_pose, explained, kept
) -> None:
    run, _ = choose_pose
    estimate = run({("bottle", "upright"): 0.95, MUG: explained}, [0.0, 0.0, 0.99, 0.01, 0.0], named=MUG)
    assert ((estimate.category, estimate.resting) == MUG) == kept


def test_a_named_pose_must_be_at_rest(choose_pose) -> None:
    run, _ = choose_pose
    explained = {("bottle", "upright"): 0.95, MUG: 0.99}
    assert run(explained, [0.0, 0.0, 1.0, 0.0, 0.0], False, named=MUG).category == "bottle"


def test_upright_objects_are_named_by_the_other_networks(choose_pose) -> None:
    run, tried = choose_pose
    run({("bottle", "upright"): 0.95}, [0.0, 0.0, 1.0, 0.0, 0.0], named=("can", "upright"))
    assert tried == [("bottle", "upright")]


def test_what_is_named_for_sure_is_fitted_first_where_there_is_no_class(choose_pose) -> None:
    run, tried = choose_pose
    assert run({MUG: 0.9}, np.full(5, 0.2), named=MUG).resting == "upside-down"
    assert tried == [MUG]
    estimate = run({MUG: 0.5, ("can", "lying"): 0.95}, np.full(5, 0.2), named=MUG)
    assert (estimate.category, estimate.resting) == ("can", "lying")


@pytest.mark.parametrize(("can", "best"), [(0.90, "bottle"), (0.97, "can")])
def test_depth_decides_between_classes_that_are_about_as_probable(choose_pose, can, best) -> None:
    run, tried = choose_pose
    explained = {("bottle", "lying"): 0.92, ("can", "lying"): can}
    named = {("bottle", "lying"): 0.5, ("can", "lying"): 0.4, ("mug", "lying"): 0.1}
    assert run(explained, np.full(5, 0.2), named=named).category == best
    assert set(tried) == set(explained)
