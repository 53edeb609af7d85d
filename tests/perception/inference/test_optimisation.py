"""Stages, start, progress and convergence of a fit."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.inference.fit import fit_object
from perception.inference.fit_config import FitConfig, FitStage
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.inference.optimisation import FitStart, FitStep, _settled, optimise_object
from perception.types import SupportPlane

PLANE = SupportPlane()


def views(observations, category: str) -> ObjectViews:
    return ObjectViews(0, category, 1.0, tuple(observations))


def test_progress_counts_the_iterations_and_ends_at_the_result(can, decoder) -> None:
    steps: list[FitStep] = []
    seen = views(can.observations((0.0,)), "can")
    config = FitConfig(stages=(FitStage(24, 1, 4), FitStage(24, 0, 4)), relinearise_every=2)
    fit = optimise_object(seen, decoder, PLANE, config, steps.append)
    assert [step.iteration for step in steps] == [0, 4, 6, 8]
    assert np.isnan(steps[0].residual) and steps[0].code.tolist() == [0.0] * 16
    np.testing.assert_array_equal(steps[-1].code, fit.state.code)
    capped = np.minimum(np.abs(np.concatenate([fit.residual_object, fit.residual_background])), 0.03)
    assert steps[-1].residual == pytest.approx(capped.mean())
    assert len(fit.trace) == 8


def test_a_start_from_fewer_views_leaves_the_last_stage_alone(can, decoder) -> None:
    config = FitConfig(stages=(FitStage(24, 1, 8), FitStage(32, 0, 10)))
    seen = views(can.observations((0.0, 1.5, 3.0, 4.5)), "can")
    before = fit_object(replace(seen, observations=seen.observations[:2]), decoder, PLANE, config)
    anew = optimise_object(seen, decoder, PLANE, config)
    warm = optimise_object(replace(seen, start=before), decoder, PLANE, config)
    assert len(warm.trace) <= 10 < len(anew.trace)
    assert warm.trace[0].cost < 1.5 * warm.evaluation.cost
    assert warm.evaluation.cost == pytest.approx(anew.evaluation.cost, rel=0.1)
    np.testing.assert_allclose(warm.state.pose.translation, anew.state.pose.translation, atol=1e-3)


def test_more_than_three_views_share_the_pixels_of_three(can, decoder) -> None:
    config = FitConfig(stages=(FitStage(24, 0, 1),))
    counts = []
    for azimuths in ((0.0, 2.0, 4.0), (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)):
        fit = optimise_object(views(can.observations(azimuths), "can"), decoder, PLANE, config)
        counts.append(len(fit.inside))
    assert counts[1] == pytest.approx(counts[0], rel=0.1)


def test_the_start_comes_from_the_first_views_alone(can) -> None:
    seen = can.observations((0.0, 2.0))
    wide = ObjectObservation(seen[1].frame, cv2.dilate(seen[1].mask.astype(np.uint8), np.ones((31, 31))) > 0)
    config = FitConfig(start_views=1)
    alone, both = (FitStart.of(views(v, "can"), PLANE, config) for v in (seen[:1], [seen[0], wide]))
    np.testing.assert_array_equal(alone.poses[0].scale, both.poses[0].scale)
    others = FitStart.of(views([seen[0], wide], "can"), PLANE, FitConfig())
    assert others.poses[0].scale[0] != both.poses[0].scale[0]


@pytest.mark.parametrize("category, sigma", [("can", 0.08), ("mug", 1.0)])
def test_the_size_of_mugs_is_hardly_known(can, category, sigma) -> None:
    start = FitStart.of(views(can.observations((0.0,)), category), PLANE, FitConfig())
    assert start.size.sigma == sigma
    np.testing.assert_array_equal(start.size.scale, start.poses[0].scale)
    voxel = 2 * start.poses[0].scale[0] / 32
    assert start.sampling.samples == round(2 * start.sampling.reach / (FitConfig().step[category] * voxel))


def test_settled_means_half_a_standard_deviation() -> None:
    hessian = np.diag(np.full(25, 4.0))  # standard deviation 0.5
    assert _settled(np.full(25, 0.249), hessian)
    assert not _settled(np.full(25, 0.251), hessian)


def test_views_with_points_above_the_plane_are_required(can, decoder) -> None:
    with pytest.raises(InvalidInputError, match="above the support plane"):
        optimise_object(views(can.observations((0.0,)), "can"), decoder, SupportPlane(offset=1.0))
    with pytest.raises(InvalidInputError, match="without any view"):
        optimise_object(views([], "can"), decoder, PLANE)


def test_the_axis_starts_toward_a_direction(make_table, decoder) -> None:
    """Of both ways round, those within 90 degrees; all if there are none."""
    table = make_table("can", (0.0,), yaw=0.0)
    seen = views(table.observations((0.0,)), "can")
    lying = FitConfig(resting="lying")
    both = np.array([pose.rotation[:, 2] for pose in FitStart.of(seen, PLANE, lying).poses])
    toward = tuple(both[0].tolist())
    one = [pose.rotation[:, 2] for pose in FitStart.of(seen, PLANE, replace(lying, toward=toward)).poses]
    assert 0 < len(one) < len(both) and all(axis @ both[0] > 0 for axis in one)
    up = replace(FitConfig(), toward=(0.0, 0.0, -1.0))
    assert len(FitStart.of(seen, PLANE, up).poses) == len(FitStart.of(seen, PLANE, FitConfig()).poses)
