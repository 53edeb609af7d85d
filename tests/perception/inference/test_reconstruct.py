"""Whole scans: instances over frames, hidden pixels, parallel and repeatable."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from perception.errors import PerceptionError
from perception.inference import fit
from perception.inference import reconstruct as reconstruction
from perception.inference.acceptance import AcceptanceModel
from perception.inference.fit_config import FitConfig, FitStage
from perception.inference.reconstruct import (
    ReconstructOptions,
    gather_instances,
    hidden_by,
    mean_probabilities,
    reconstruct,
    waves_of_stacks,
)
from perception.types import ObjectDetection, RejectedObject, SupportPlane

QUICK = FitConfig(stages=(FitStage(24, 1, 3), FitStage(32, 0, 5)))


@pytest.fixture(scope="module")
def scan(make_table):
    """Two frames; instance 4 is a can seen in both, instance 2 a sliver that holds no surface."""
    seen = make_table("can", (0.5,), yaw=0.0).observations((0.0, 2.0))
    frames = [observation.frame for observation in seen]
    sliver = np.zeros_like(seen[0].mask)
    sliver[-12:, :20] = True
    detections = [
        [
            ObjectDetection("can", 0.8, seen[0].mask, instance_id=4),
            ObjectDetection("mug", 0.5, sliver, instance_id=2),
        ],
        [ObjectDetection("can", 0.6, seen[1].mask, instance_id=4), ObjectDetection("mug", 0.5, sliver)],
    ]
    return frames, detections


def test_instances_gather_their_views(scan) -> None:
    mug, can = gather_instances(*scan)
    assert (mug.id, mug.category, len(mug.observations)) == (2, "mug", 1)
    assert (can.id, can.category, len(can.observations)) == (4, "can", 2)
    assert can.score == pytest.approx(0.7)
    assert len(gather_instances(*scan, max_views=1)[1].observations) == 1


def test_reconstruct_goes_on_without_what_cannot_be_fitted(scan, decoder, caplog) -> None:
    calls = []
    options = ReconstructOptions(progress=lambda *args: calls.append(args))
    estimates = reconstruct(*scan, decoder, SupportPlane(), QUICK, options)
    assert [estimate.name for estimate in estimates] == ["can_4"]
    assert estimates[0].n_views == 2
    assert "mug_2 is left out: no view has 30 measured points" in caplog.text
    assert [call[:2] for call in calls] == [(1, 2), (2, 2)]


def test_candidates_that_are_no_objects_are_no_warning(scan, decoder, caplog) -> None:
    rejected = []
    options = ReconstructOptions(on_rejected=rejected.append, tentative={2})
    reconstruct(*scan, decoder, SupportPlane(), QUICK, options)
    assert "mug_2" not in caplog.text
    assert [item.id for item in rejected] == [2]


FAILURES = [
    np.linalg.LinAlgError("Singular matrix"),
    ValueError("Surface level must be\nwithin"),
    MemoryError(),
]


@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
@pytest.mark.parametrize(
    "stage", ["optimise_object", "mesh_from_grid", "refine_mesh", "calibrated_deviation"]
)
def test_a_failure_of_one_object_costs_that_object_alone(
    scan, decoder, caplog, monkeypatch, stage, failure
) -> None:
    """The second object fails in one stage of its fit."""
    frames, ((can, _), (other, _)) = scan
    detections = [[can, replace(can, instance_id=5)], [other, replace(other, instance_id=5)]]
    real, calls = getattr(fit, stage), []

    def fails_once(*args, **kwargs):
        calls.append(args)
        if len(calls) == 2:
            raise failure
        return real(*args, **kwargs)

    monkeypatch.setattr(fit, stage, fails_once)
    rejected: list[RejectedObject] = []
    options = ReconstructOptions(workers=1, on_rejected=rejected.append)
    (kept,) = reconstruct(frames, detections, decoder, SupportPlane(), QUICK, options)
    assert kept.id == 4
    (item,) = rejected
    assert item.name == "can_5" and type(failure).__name__ in item.reason and "\n" not in item.reason
    assert caplog.text.count("can_5 is left out: ") == 1


def test_each_object_is_fitted_on_its_own_support_plane(scan, decoder, monkeypatch) -> None:
    frames, ((can, mug), _) = scan
    planes, used = (SupportPlane(), SupportPlane(offset=0.3)), {}

    def fail(views, _decoder, plane, *_):
        used[views.id] = plane
        raise PerceptionError("only its plane matters here")

    monkeypatch.setattr(sys.modules[reconstruct.__module__], "fit_object", fail)
    reconstruct(frames[:1], [[can, replace(mug, support=1)]], decoder, planes, QUICK)
    assert used == {4: planes[0], 2: planes[1]}


def test_workers_do_not_change_the_result(scan, decoder) -> None:
    one, two = (reconstruct(*scan, decoder, SupportPlane(), QUICK, ReconstructOptions(n))[0] for n in (1, 2))
    np.testing.assert_array_equal(one.code, two.code)
    np.testing.assert_array_equal(one.mesh.vertices, two.mesh.vertices)


def test_stacks_are_fitted_from_the_lowest_object_up(scan) -> None:
    (_, views) = gather_instances(*scan)
    piles = [replace(views, id=id) for id in range(6)]
    below = {1: 0, 4: 3, 2: 1}  # 2 on 1 on 0, 4 on 3, and 5 alone
    waves = [[views.id for views in wave] for wave in waves_of_stacks(piles, below)]
    assert waves == [[0, 3, 5], [1, 4], [2]]
    beside = [[views.id for views in wave] for wave in waves_of_stacks(piles[:3], {1: 0, 2: 0})]
    assert beside == [[0], [1], [2]]  # both may lower what is below them
    assert [len(wave) for wave in waves_of_stacks(piles[:2], {0: 1, 1: 0})] == [0, 2]


def test_what_is_known_to_be_below_is_fitted_first(scan, decoder, monkeypatch) -> None:
    """Although by what is measured of it, it rests on the other one."""
    order = []

    def found(views, *_):
        order.append(views.id)
        raise ValueError

    monkeypatch.setattr(reconstruction, "find_stacks", lambda *_: {4: 2})
    monkeypatch.setattr(reconstruction, "fit_object", found)
    for known, first in (({2: 4}, 4), ({}, 2)):
        order.clear()
        reconstruct(*scan, decoder, SupportPlane(), QUICK, ReconstructOptions(rests_on=known))
        assert order[0] == first and len(order) == 2


@pytest.mark.parametrize("rests_on", [None, 2])
def test_a_ring_on_its_support_is_left_out(scan, decoder, monkeypatch, rests_on) -> None:
    """Of what rests on another object the height of its floor above that is not known well enough."""
    frames, rows = scan
    known = [[replace(d, class_probabilities=np.full(5, 0.2)) for d in row] for row in rows]
    monkeypatch.setattr(reconstruction, "is_ring", lambda estimate, *_: estimate.id == 4)
    monkeypatch.setattr(reconstruction, "find_stacks", lambda *_: {4: 2})
    whole = reconstruct(*scan, decoder, SupportPlane(), QUICK)[0]
    for name in ("fit_best_class", "rest_on"):
        monkeypatch.setattr(
            reconstruction, name, lambda views, *_: replace(whole, id=views.id, rests_on=rests_on)
        )
    rejected: list[RejectedObject] = []
    options = ReconstructOptions(acceptance=AcceptanceModel({}, 0.4), on_rejected=rejected.append)
    found = {e.id for e in reconstruct(frames, known, decoder, SupportPlane(), QUICK, options)}
    assert (found, [item.id for item in rejected]) == (({2}, [4]) if rests_on is None else ({2, 4}, []))
    given = {e.id for e in reconstruct(*scan, decoder, SupportPlane(), QUICK, options)}
    assert given == {2, 4}, "a class that was given is kept"


def test_what_is_clearly_behind_hides_nothing(scan) -> None:
    frame, mask = scan[0][0], scan[1][0][0].mask
    own = float(np.quantile(frame.depth[mask], 0.98))
    depth = frame.depth.copy()
    near, far = np.zeros_like(mask), np.zeros_like(mask)
    near[10:20, 10:20], far[40:50, 10:20] = True, True
    depth[near], depth[far] = own - 0.1, own + 0.1
    changed = type(frame)(0.0, frame.rgb, depth, frame.intrinsics, frame.T_world_camera)
    hidden = hidden_by(changed, mask, [near, far])
    assert hidden[15, 15] and not hidden[45, 15]
    assert not (hidden & mask).any()
    assert not hidden_by(changed, mask, []).any()


def test_poses_of_several_views_are_averaged_in_log_space() -> None:
    a, b = np.array([0.8, 0.2, 0.0]), np.array([0.2, 0.2, 0.6])
    ratio = np.sqrt(np.array([0.8 * 0.2, 0.2 * 0.2, 0.005 * 0.6]))  # no view alone rules a pose out
    np.testing.assert_allclose(mean_probabilities([a, b]), ratio / ratio.sum())
    assert mean_probabilities([]).size == 0
