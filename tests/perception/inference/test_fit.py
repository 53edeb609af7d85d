"""Fits of objects whose shape and pose are known."""

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.geometry import yaw_of
from perception.inference.fit import FitConfig, fit_object
from perception.inference.meshing import mesh_from_code
from perception.inference.observation import (
    Crop,
    ObjectObservation,
    ObjectViews,
    PixelConfig,
    SamplingRange,
    gather_pixels,
)
from perception.inference.problem import FitProblem, FitState, NoiseConfig, SizePrior, SupportCamera
from perception.inference.shape_model import linearise
from perception.metrics import reconstruction_metrics
from perception.rendering.pose import ObjectPose
from perception.types import SupportPlane

PLANE = SupportPlane()


def views(observations, category: str, object_id: int = 0, score: float = 1.0) -> ObjectViews:
    return ObjectViews(object_id, category, score, tuple(observations))


def _surface_error(estimate, table) -> float:
    truth = mesh_from_code(table.decoder, table.category, table.code, table.pose.scale)
    truth = truth.transformed(table.pose.T_world_object)
    return reconstruction_metrics(estimate.mesh_world, truth, np.random.default_rng(0), n=5000).chamfer_l1


@pytest.fixture(scope="module")
def can(make_table):
    return make_table("can", (1.5, -1.0), yaw=0.0)


@pytest.fixture(scope="module")
def can_estimate(can, decoder):
    return fit_object(views(can.observations((0.0, 2.0, 4.0)), "can", 7, 0.9), decoder, PLANE)


def test_recovers_a_known_object(can, can_estimate) -> None:
    assert (
        _surface_error(can_estimate, can) < 0.0015
    )  # 5000 samples of a can this size differ by 1 mm themselves
    np.testing.assert_allclose(can_estimate.T_world_object[:2, 3], can.pose.translation[:2], atol=0.0015)
    assert can_estimate.height == pytest.approx(2 * 0.67 * 0.05, abs=0.002)
    assert can_estimate.radius == pytest.approx(0.67 * 0.05, abs=0.0015)


def test_estimate_says_how_it_went(can_estimate) -> None:
    assert (can_estimate.id, can_estimate.category, can_estimate.n_views) == (7, "can", 3)
    assert can_estimate.status == "converged"
    assert 0.0005 < can_estimate.residual < 0.004
    covariance = can_estimate.covariance
    assert covariance.shape == (25, 25)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


def test_stands_on_the_plane(can_estimate) -> None:
    assert abs(can_estimate.mesh_world.vertices[:, 2].min()) < 0.002
    assert can_estimate.T_world_object[2, 2] > np.cos(0.02)


def test_one_view_is_enough_for_a_shape_of_the_prior(make_table, decoder) -> None:
    table = make_table("can", (1.0, 0.5), yaw=0.0)
    estimate = fit_object(views(table.observations((1.0,)), "can"), decoder, PLANE)
    assert _surface_error(estimate, table) < 0.003


def test_finds_the_yaw_of_a_mug_that_nobody_told(make_table, decoder) -> None:
    table = make_table("mug", (0.0, 0.0, 1.0), yaw=2.4)
    estimate = fit_object(views(table.observations((0.3, 2.0, 3.5)), "mug"), decoder, PLANE)
    error = yaw_of(estimate.T_world_object[:3, :3]) - 2.4
    assert abs((error + np.pi) % (2 * np.pi) - np.pi) < np.deg2rad(8)


def test_depth_holes_and_covered_pixels_are_left_out(can, decoder) -> None:
    observations = []
    for seen in can.observations((0.0, 2.0, 4.0)):
        depth = seen.frame.depth.copy()
        rows, columns = np.nonzero(seen.mask)
        middle = int(np.median(columns))
        depth[rows.min() : rows.min() + 10, :] = 0.0
        ignore = np.zeros_like(seen.mask)
        ignore[:, middle : middle + 15] = True
        depth[:, middle : middle + 15] = 0.2  # something in front of the lens
        frame = type(seen.frame)(0.0, seen.frame.rgb, depth, seen.frame.intrinsics, seen.frame.T_world_camera)
        observations.append(ObjectObservation(frame, seen.mask & ~ignore, ignore))
    assert _surface_error(fit_object(views(observations, "can"), decoder, PLANE), can) < 0.002


def test_same_input_same_output(can, decoder, can_estimate) -> None:
    again = fit_object(views(can.observations((0.0, 2.0, 4.0)), "can"), decoder, PLANE)
    np.testing.assert_array_equal(again.code, can_estimate.code)
    np.testing.assert_array_equal(again.T_world_object, can_estimate.T_world_object)


def test_nothing_above_the_plane_is_an_error(can, decoder) -> None:
    seen = can.observations((0.0,))
    with pytest.raises(InvalidInputError, match="above the support plane"):
        fit_object(views(seen, "can"), decoder, SupportPlane(offset=1.0))
    with pytest.raises(InvalidInputError, match="without any view"):
        fit_object(views([], "can"), decoder, PLANE)


def test_problem_jacobian_by_finite_differences(make_table, decoder) -> None:
    """All rows of the problem at once, with weights aside: renders, priors, and the camera underneath."""
    table = make_table("mug", (0.3,), yaw=0.4)
    observations = table.observations((0.0,))
    pixels = gather_pixels(
        observations, SamplingRange(table.pose.translation, 0.1, 300), Crop(24, 1), PixelConfig()
    )
    code = table.code + 0.1
    shape = linearise(decoder, "mug", code)
    support = SupportCamera.under(table.pose, PLANE, 0.04, 0.08)
    problem = FitProblem(pixels, shape, support, NoiseConfig(), SizePrior(1.1 * table.pose.scale, 0.1))
    state = FitState(ObjectPose(table.pose.rotation, table.pose.translation + 0.003, table.pose.scale), code)
    here = problem(state)
    data = here.weights > 0
    for k in range(25):
        step = np.zeros(25)
        step[k] = 2e-4
        ahead, behind = problem(state.moved(step)).residuals, problem(state.moved(-step)).residuals
        numeric = ((ahead - behind) / (2 * step[k]))[data]
        error = np.abs(here.jacobian[data, k] - numeric) / max(np.abs(numeric).max(), 0.02)
        assert np.median(error) < 0.01, k
        assert np.quantile(error, 0.9) < 0.1, k


def test_config_budget_is_kept(can, decoder) -> None:
    iterations = sum(stage.iterations for stage in FitConfig().stages)
    assert iterations == 30


def around(table) -> SamplingRange:
    return SamplingRange(table.pose.translation, 0.1, 100)


def test_every_other_background_pixel_stands_for_two(can) -> None:
    dense, sparse = (
        gather_pixels(can.observations((0.0, 0.8)), around(can), Crop(48), config)
        for config in (PixelConfig(), PixelConfig(sparse_background=True))
    )
    outside, fewer = ~dense.inside, ~sparse.inside
    assert fewer.sum() == pytest.approx(outside.sum() / 2, rel=0.05)
    assert sparse.weight[fewer].sum() == pytest.approx(dense.weight[outside].sum(), rel=0.05)
    np.testing.assert_array_equal(sparse.rays.directions[~fewer], dense.rays.directions[~outside])
    blurred = gather_pixels(
        can.observations((0.0,)), around(can), Crop(48, 1), PixelConfig(sparse_background=True)
    )
    assert set(np.unique(blurred.weight)) == {np.float32(0.2), np.float32(1.0)}


def test_finer_crops_say_no_more(can) -> None:
    sums = {}
    for crop in (24, 36, 48, 4000):
        seen = can.observations((0.0, 0.8))
        pixels = gather_pixels(seen, around(can), Crop(crop, reference=36), PixelConfig())
        sums[crop] = float(pixels.weight[pixels.inside].sum())
        if crop == 36:
            assert set(np.unique(pixels.weight)) == {np.float32(0.2), np.float32(1.0)}
    for crop, total in sums.items():
        assert total == pytest.approx(sums[36], rel=0.1), crop
