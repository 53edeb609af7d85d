"""Which way round an object is kept, for given fits."""

from dataclasses import fields, replace

import numpy as np
import pytest

from perception.detection.yaw import YAW_BINS, soft_labels
from perception.inference import pose_choice, resting_choice, scored_fits, way_round
from perception.inference.acceptance import AcceptanceModel
from perception.inference.class_choice import fit_best_class
from perception.inference.evidence import Evidence
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.inference.scored_fits import ScoredFit
from perception.types import (
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
MODEL = AcceptanceModel({}, 0.4)
VIEWS = ObjectViews(3, "can", 0.9, (OBSERVATION,), np.full(5, 0.2))


@pytest.fixture(autouse=True)
def long_enough(monkeypatch):
    """The meshes of these fits are no shapes at all."""
    monkeypatch.setattr(resting_choice, "is_stubby", lambda _: False)


@pytest.mark.parametrize("pose", ["upright", "lying", "upside-down"])
def test_a_can_with_the_wrong_end_up_is_fitted_the_other_way_round(monkeypatch, decoder, pose) -> None:
    """Away from the first axis; the surface and the score stay."""
    axes = []

    def scored(views, decoder, plane, model, config, on_step):
        axes.append(config.toward)
        mesh, first = TriangleMesh(np.eye(3), np.arange(3)[None]), config.toward is None
        estimate = ObjectEstimate(
            3, "can", np.zeros(16), np.eye(4), np.ones(3), mesh, 0.8 if first else 0.1, resting=config.resting
        )
        return ScoredFit(estimate, replace(EVIDENCE, explained=0.97 if first else 0.8), None)

    monkeypatch.setattr(scored_fits, "scored_fit", scored)
    monkeypatch.setattr(
        way_round, "is_turned_over", lambda estimate, seen, is_doubtful=False: not is_doubtful
    )
    monkeypatch.setattr(resting_choice, "nearest_hypotheses", lambda *_: [("can", pose)])
    monkeypatch.setattr(pose_choice, "rests_stably", lambda mesh, plane: True)
    views = ObjectViews(3, "can", 0.9, (OBSERVATION,), np.full(5, 0.2))
    bottle = np.array([0.5 * (posed == ("bottle", pose)) for posed in POSED_CLASSES] + [0.5])
    named = replace(views, pose_probabilities=bottle)
    if ("bottle", pose) in POSED_CLASSES:
        assert fit_best_class(named, decoder, SupportPlane(), MODEL, FitConfig()).resting == pose
    if pose == "upright":  # a can on its narrow end resembles a bottle, but not for the class network
        for p_can, resting in ((0.85, pose), (0.97, "upside-down")):
            sure = replace(named, class_probabilities=np.array([0.0, 0.0, 0.98 - p_can, p_can, 0.02]))
            found = fit_best_class(sure, decoder, SupportPlane(), MODEL, FitConfig())
            assert (found.category, found.resting) == ("can", resting)
    axes.clear()
    estimate = fit_best_class(views, decoder, SupportPlane(), MODEL, FitConfig())
    assert axes == [None, (0.0, 0.0, -1.0)]
    reversed_pose = {"upright": "upside-down", "upside-down": "upright", "lying": "lying"}[pose]
    assert estimate.resting == reversed_pose and estimate.score == 0.8
    np.testing.assert_array_equal(estimate.T_world_object, np.diag([1.0, -1.0, -1.0, 1.0]))
    np.testing.assert_array_equal(estimate.mesh_world.vertices, np.eye(3))


@pytest.fixture
def fit_lying(monkeypatch, decoder):
    """Fits a lying object of a class and tells whether the second fit, the other way round, was kept."""

    def run(category, scored, by_sides) -> bool:
        monkeypatch.setattr(scored_fits, "scored_fit", scored)
        monkeypatch.setattr(way_round, "is_turned_over", lambda *_: by_sides)
        monkeypatch.setattr(resting_choice, "nearest_hypotheses", lambda *_: [(category, "lying")])
        monkeypatch.setattr(pose_choice, "rests_stably", lambda mesh, plane: True)
        views = ObjectViews(3, category, 0.9, (OBSERVATION,), np.full(5, 0.2))
        estimate = fit_best_class(views, decoder, SupportPlane(), MODEL, FitConfig())
        return bool(estimate.T_world_object[2, 2] < 0)

    return run


@pytest.mark.parametrize(
    ("first", "second", "systematic", "by_sides", "turned"),
    [
        (0.984, 0.992, 0.3, False, True),  # 0.008 + 0.005 is less than 0.65 (0.016 + 0.005)
        (0.992, 0.992, 0.3, False, False),  # as much is explained
        (0.984, 0.992, 0.45, False, False),  # the surface is hardly closer
        (0.984, 0.984, 0.5, True, True),  # its sides tell, where the depth does not
        (0.992, 0.984, 0.7, True, False),  # where it does, they are those of a bottle
    ],
)
def test_a_can_lies_the_way_round_that_explains_much_more(
    fit_lying, first, second, systematic, by_sides, turned
) -> None:
    def scored(views, decoder, plane, model, config, on_step):
        mesh, is_first = TriangleMesh(np.eye(3), np.arange(3)[None]), config.toward is None
        T = np.eye(4) if is_first else np.diag([1.0, -1.0, -1.0, 1.0])
        estimate = ObjectEstimate(3, "can", np.zeros(16), T, np.ones(3), mesh, 0.8, resting=config.resting)
        explained, deviation = (first, 0.5) if is_first else (second, systematic)
        return ScoredFit(estimate, replace(EVIDENCE, explained=explained, systematic=deviation), None)

    assert fit_lying("can", scored, by_sides) == turned


@pytest.mark.parametrize(
    ("along", "explained", "systematic", "by_sides", "named", "kept"),
    [
        (-1, 0.99, 0.3, False, 0.2, "bottle"),  # the can misses 3 %
        (1, 0.99, 0.3, False, 0.2, "can"),  # lies the same way round
        (1, 0.99, 0.3, True, 0.2, "bottle"),  # but the can's sides tell the opposite
        (-1, 0.99, 0.3, True, 0.2, "can"),
        (-1, 0.98, 0.3, False, 0.2, "can"),  # hardly explains more
        (-1, 0.99, 0.45, False, 0.2, "can"),  # the surface is hardly closer
        (-1, 0.99, 0.3, False, 0.1, "can"),  # the pose network does not think of a bottle
    ],
)
def test_a_bottle_that_explains_much_more_contradicts_a_can_the_other_way_round(
    monkeypatch, decoder, along, explained, systematic, by_sides, named, kept
) -> None:
    def scored(views, decoder, plane, model, config, on_step):
        is_can = views.category == "can"
        way = along if not is_can else (1 if config.toward is None else -1)
        T = np.diag([1.0, way, way, 1.0])
        mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
        estimate = ObjectEstimate(3, views.category, np.zeros(16), T, np.ones(3), mesh, 0.8, resting="lying")
        seen = (0.97, 0.5) if is_can else (explained, systematic)
        return ScoredFit(estimate, replace(EVIDENCE, explained=seen[0], systematic=seen[1]), None)

    monkeypatch.setattr(scored_fits, "scored_fit", scored)
    turned_over = lambda estimate, *_: by_sides and estimate.category == "can"  # noqa: E731
    monkeypatch.setattr(way_round, "is_turned_over", turned_over)
    monkeypatch.setattr(pose_choice, "rests_stably", lambda mesh, plane: True)
    p = {("can", "lying"): 0.9 - named, ("bottle", "lying"): named}
    poses = np.array([p.get(posed, 0.0) for posed in POSED_CLASSES] + [0.1])
    views = ObjectViews(3, "mug", 0.9, (OBSERVATION,), np.full(5, 0.2), poses)
    assert fit_best_class(views, decoder, SupportPlane(), MODEL, FitConfig()).category == kept


@pytest.mark.parametrize(("explained", "residual", "score", "closed_cup", "turned"), [
    (0.97, 0.7, 0.8, False, True), (0.95, 0.7, 0.8, False, False), (0.97, 0.9, 0.8, False, False),
    (0.95, 1.2, 0.95, False, True), (0.95, 1.3, 0.95, False, False),
    (0.97, 0.7, 0.8, True, False), (0.95, 0.9, 0.8, True, True), (0.90, 0.9, 0.8, True, False),
], ids=[
    "closer", "less", "hardly-closer", "likelier", "likelier-but-less-close", "closer-cup", "cup", "poor-cup",
])  # fmt: skip
def test_of_a_lying_bottle_the_way_round_that_is_clearly_closer_or_likelier_is_kept(
    fit_lying, explained, residual, score, closed_cup, turned
) -> None:
    """Unless that is a closed cup with its lid down, and both are alike."""

    def scored(views, decoder, plane, model, config, on_step):
        mesh, first = TriangleMesh(np.eye(3), np.arange(3)[None]), config.toward is None
        T = np.diag([1.0, 1.0, 1.0, 1.0]) if first else np.diag([1.0, -1.0, -1.0, 1.0])
        p, *seen = (0.9, 0.96, 1.0) if first else (score, explained, residual)
        estimate = ObjectEstimate(3, "bottle", np.zeros(16), T, np.ones(3), mesh, p, resting=config.resting)
        return ScoredFit(estimate, replace(EVIDENCE, explained=seen[0], residual=seen[1]), None)

    assert fit_lying("bottle", scored, closed_cup) == turned


@pytest.mark.parametrize(
    ("necks", "systematic", "turned"),
    [
        ((0.7, 0.7), 0.4, True),  # the score, 0.95 against 0.9 for the first, knows nothing of the ends
        ((0.7, 0.7), 0.6, False),
        ((0.6, 0.9), 0.4, False),  # the first has a neck
        ((0.9, 0.6), 0.4, False),  # so has the second, with the lower score
    ],
)
def test_of_a_lying_bottle_without_a_neck_the_way_round_that_is_closer_is_kept(
    fit_lying, necks, systematic, turned
) -> None:
    def scored(views, decoder, plane, model, config, on_step):
        mesh, first = TriangleMesh(np.eye(3), np.arange(3)[None]), config.toward is None
        T = np.diag([1.0, 1.0, 1.0, 1.0]) if first else np.diag([1.0, -1.0, -1.0, 1.0])
        p = 0.95 if first else 0.9
        estimate = ObjectEstimate(3, "bottle", np.zeros(16), T, np.ones(3), mesh, p, resting=config.resting)
        seen = {"neck": necks[not first], "systematic": 0.5 if first else systematic}
        return ScoredFit(estimate, replace(EVIDENCE, **seen), None)

    assert fit_lying("bottle", scored, False) == turned


@pytest.mark.parametrize("category", ["mug", "bottle", "can"])
@pytest.mark.parametrize(
    ("named", "sure", "residual", "turned"),
    [
        (-1, 0.9, 0.5, True),
        (1, 0.9, 0.5, False),
        (-1, 0.0, 0.5, False),  # the network knows nothing of it
        (0, 0.9, 0.5, False),  # it was not asked
        (-1, 0.5, 0.3, False),  # the depth is clear
        (-1, 0.9, 0.3, True),  # but the network is sure
    ],
)
def test_what_lies_points_where_the_axis_network_says(
    monkeypatch, decoder, category, named, sure, residual, turned
) -> None:
    """The first fit lies along x, the other one along -x."""

    def scored(views, decoder, plane, model, config, on_step):
        way = 1.0 if config.toward is None else -1.0
        T = np.array([[0, 0, way, 0], [0, 1, 0, 0], [-way, 0, 0, 0], [0, 0, 0, 1]])
        mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
        score = 0.8 if way > 0 else 0.7
        estimate = ObjectEstimate(3, category, np.zeros(16), T, np.ones(3), mesh, score, resting="lying")
        return ScoredFit(estimate, replace(EVIDENCE, residual=residual if way > 0 else 0.5), None)

    monkeypatch.setattr(scored_fits, "scored_fit", scored)
    monkeypatch.setattr(way_round, "is_turned_over", lambda *_: False)
    monkeypatch.setattr(resting_choice, "nearest_hypotheses", lambda *_: [(category, "lying")])
    monkeypatch.setattr(pose_choice, "rests_stably", lambda mesh, plane: True)
    angle = np.array([0.0 if named > 0 else np.pi])
    p = sure * soft_labels(angle)[0].astype(np.float64) + (1 - sure) / YAW_BINS
    views = replace(VIEWS, category=category, axis_probabilities=p if named else np.zeros(0))
    estimate = fit_best_class(views, decoder, SupportPlane(), MODEL, FitConfig())
    assert (estimate.T_world_object[0, 2] < 0) == turned and estimate.score == 0.8
