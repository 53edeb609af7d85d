"""One object of a reconstruction evaluation: where it comes from, what is seen of it, how it is scored."""

import json
from pathlib import Path

import numpy as np
import pytest

import sim_assets.objects
from app.evaluation import reconstruction_object
from app.evaluation.reconstruction_object import (
    PROTOCOL,
    Subject,
    _merged,
    _model,
    _rng,
    evaluate_subject,
    load_sight,
)
from app.options import METHODS, EvaluateOptions
from perception.inference import ablations
from perception.types import CATEGORIES, ObjectDetection, is_unclassified


def options(out: Path | None = None, **changes) -> EvaluateOptions:
    fields = {"what": "reconstruction", "objects": "mug=2,can=1", "views": (1,), "methods": ("full",)}
    return EvaluateOptions(**({"seed": 3, "out": out, "quiet": True} | fields | changes))


def test_names_of_subjects() -> None:
    assert Subject("mug", 7).name == "mug_007"
    assert Subject("can", 0, Path("dir/soup.ply")).name == "can_000_soup"


@pytest.mark.parametrize("category", CATEGORIES)
def test_objects_come_from_the_test_families(category, monkeypatch) -> None:
    drawn = []
    original = sim_assets.objects.sample_object

    def recorded(category, split, rng):
        drawn.append((category, split))
        return original(category, split, rng)

    monkeypatch.setattr(sim_assets.objects, "sample_object", recorded)
    model = _model(options(), Subject(category, 3))
    assert drawn == [(category, "test")]
    expected = original(category, "test", _rng(options(), Subject(category, 3), 0))
    np.testing.assert_array_equal(model.mesh.vertices, expected.mesh.vertices)


def test_meshes_of_a_user_are_loaded(monkeypatch) -> None:
    loaded = []
    monkeypatch.setattr(sim_assets.objects, "load_user_object", lambda *a, **k: loaded.append((a, k)))
    _model(options(), Subject("can", 0, Path("soup.ply")))
    assert loaded == [((Path("soup.ply"), "can"), {"collision": False})]


def test_random_streams_differ_by_seed_class_object_and_purpose() -> None:
    keys = [(3, "can", 0, 0), (4, "can", 0, 0), (3, "mug", 0, 0), (3, "can", 1, 0), (3, "can", 0, 1)]
    numbers = [_rng(options(seed=seed), Subject(c, k), purpose).random() for seed, c, k, purpose in keys]
    assert len(set(numbers)) == len(numbers)
    assert (
        _rng(options(), Subject("can", 0), 1).random()
        == _rng(options(objects="can=9"), Subject("can", 0), 1).random()
    )


def test_protocol_is_the_papers() -> None:
    assert PROTOCOL.start_views == 1 and sum(stage.iterations for stage in PROTOCOL.stages) == 30
    assert METHODS == ablations.METHODS
    assert reconstruction_object.CONVERGENCE_ITERATIONS == 150


def test_parts_of_the_one_object_are_joined() -> None:
    def part(column: int, bowl: float) -> ObjectDetection:
        mask = np.zeros((4, 6), bool)
        mask[:, column] = True
        return ObjectDetection("bowl", 0.9, mask, np.array([0.0, bowl, 0.0, 0.0, 1 - bowl]))

    (joined,) = _merged([part(1, 0.9), part(2, 0.8), part(5, 0.1)], "bowl")
    assert joined.mask[0].tolist() == [False, True, True, False, False, False]
    assert joined.category == "bowl" and joined.instance_id == 0
    (doubtful,) = _merged([part(1, 0.1), part(2, 0.3)], "bowl")
    assert doubtful.mask[0].tolist() == [False, False, True, False, False, False]
    assert _merged([], "bowl") == ()


def test_given_masks_are_the_true_ones_with_a_yaw_for_mugs_alone() -> None:
    for category in ("mug", "can"):
        sight = load_sight(options(masks="given"), Subject(category, 0))
        ((found,),) = sight.detections
        assert (found.category, found.score, found.instance_id) == (category, 1.0, 0)
        assert found.class_probabilities.size == 0
        assert found.yaw_probabilities.size == (36 if category == "mug" else 0)
        inside = sight.frames[0].depth[found.mask]
        assert found.mask.sum() > 500 and np.ptp(inside[inside > 0]) < 0.3


def test_one_object_for_real() -> None:
    """A can from one view: everything from drawing it to its row."""
    line = evaluate_subject(options(methods=("full", "no_refinement")), Subject("can", 1))
    full, plain = line["rows"]
    assert line["object"] == "can_001" and full["found"] and "convergence" not in line
    assert 0 < full["accuracy"] < 0.002 and full["completion"] > 0.95
    assert full["surface_sigma"] > 0 and full["within_1_sigma"] < full["within_2_sigma"] <= 1
    assert plain["method"] == "no_refinement" and plain["accuracy"] != full["accuracy"]
    json.dumps(line)


def test_a_subject_lies_on_the_table_with_a_mask_of_no_class() -> None:
    subject = Subject("can", 0, resting="lying")
    sight = load_sight(options(poses=("lying",)), subject)
    assert abs(sight.truth.T_world_object[2, 2]) < 0.1 and sight.any_pose
    (found,) = sight.detections[0]
    assert is_unclassified(found)
    given = load_sight(options(poses=("lying",), masks="given"), subject)
    assert given.detections[0][0].category == "can" and not given.detections[0][0].class_probabilities.size
