"""Fits of objects whose shape and pose are known."""

from dataclasses import replace

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.geometry import so3_exp, yaw_of
from perception.inference.fit import FitFailedError, _status, check_finite, fit_object
from perception.inference.fit_config import FitConfig
from perception.inference.levenberg_marquardt import Evaluation
from perception.inference.meshing import mesh_from_code
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.inference.optimisation import Fit, optimise_object
from perception.inference.problem import FitState
from perception.inference.uncertainty import CalibrationConfig, calibrated_deviation
from perception.metrics import reconstruction_metrics
from perception.rendering.pose import ObjectPose
from perception.types import SupportPlane, TriangleMesh
from tests.perception.inference.test_resting import lying

PLANE = SupportPlane()


def views(observations, category: str, object_id: int = 0, score: float = 1.0) -> ObjectViews:
    return ObjectViews(object_id, category, score, tuple(observations))


def _surface_error(estimate, table) -> float:
    truth = mesh_from_code(table.decoder, table.category, table.code, table.pose.scale)
    truth = truth.transformed(table.pose.T_world_object)
    return reconstruction_metrics(estimate.mesh_world, truth, np.random.default_rng(0), n=5000).chamfer_l1


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


def test_estimate_carries_status_residual_and_covariance(can_estimate) -> None:
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


def test_finds_the_yaw_of_a_mug_without_a_yaw_distribution(make_table, decoder) -> None:
    table = make_table("mug", (0.0, 0.0, 1.0), yaw=2.4)
    estimate = fit_object(views(table.observations((0.3, 2.0, 3.5)), "mug"), decoder, PLANE)
    error = yaw_of(estimate.T_world_object[:3, :3]) - 2.4
    assert abs((error + np.pi) % (2 * np.pi) - np.pi) < np.deg2rad(8)


@pytest.mark.parametrize("azimuths", [(0.2,), (1.4, 3.0)])
def test_a_lying_can_is_found_on_its_side(decoder, azimuths) -> None:
    table = lying(decoder, 0.9)
    config = FitConfig(resting="lying")
    estimate = fit_object(views(table.observations(azimuths), "can"), decoder, PLANE, config)
    assert (estimate.resting, estimate.rests_on) == ("lying", None)
    assert _surface_error(estimate, table) < 0.003
    axis = estimate.T_world_object[:3, 2]
    assert abs(axis @ table.pose.rotation[:, 2]) > np.cos(np.deg2rad(5)) and abs(axis[2]) < np.sin(0.05)
    assert abs(estimate.mesh_world.vertices[:, 2].min()) < 0.002


@pytest.mark.parametrize("roll", [0.0, 75.0])
def test_the_handle_of_a_lying_mug_points_where_depth_shows_it(decoder, roll) -> None:
    """Among its neighbours a mug may lie with its handle straight up."""
    table = lying(decoder, 0.9, "mug")
    about_axis = so3_exp(np.array([0.0, 0.0, np.deg2rad(roll)]))
    pose = ObjectPose(table.pose.rotation @ about_axis, table.pose.translation, table.pose.scale)
    table = replace(table, pose=pose)
    config = FitConfig(resting="lying")
    estimate = fit_object(views(table.observations((0.4, 2.5, 4.6)), "mug"), decoder, PLANE, config)
    assert estimate.T_world_object[:3, 0] @ pose.rotation[:, 0] > np.cos(np.deg2rad(12))


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


def test_deviations_are_those_of_the_covariance(can, decoder) -> None:
    """Without refinement nothing but the covariance of the fit determines the surface."""
    seen = views(can.observations((0.0, 2.0)), "can")
    config = FitConfig(refine=None)
    estimate, fit = (run(seen, decoder, PLANE, config) for run in (fit_object, optimise_object))
    hessian, _ = fit.evaluation.normal_equations()
    scale = 1 / np.sqrt(np.diag(hessian))
    information = scale[:, None] * hessian * scale
    np.testing.assert_allclose(
        information @ (estimate.covariance / np.outer(scale, scale)), np.eye(25), atol=1e-2
    )
    grid, jacobian = decoder.with_jacobian("can", fit.state.code)
    undetermined = np.zeros(len(estimate.mesh.vertices))
    expected = calibrated_deviation(estimate, estimate.covariance, undetermined, grid, jacobian)
    np.testing.assert_allclose(estimate.surface_sigma, expected, rtol=1e-6)


def test_refinement_lowers_the_deviations_of_what_is_seen(can, can_estimate) -> None:
    height = can_estimate.mesh_world.vertices[:, 2]
    side = (height > 0.01) & (height < 0.06)
    floor = CalibrationConfig().floor["can"]
    assert can_estimate.surface_sigma.min() >= floor
    assert np.median(can_estimate.surface_sigma[side]) < 1.5 * floor
    assert can_estimate.surface_sigma[height < 0.001].max() > 1.5 * floor  # the bottom is not seen


def test_numbers_that_are_not_finite_are_named(can_estimate) -> None:
    check_finite(can_estimate)
    vertices = can_estimate.mesh.vertices.copy()
    vertices[3, 1] = np.nan
    bad = replace(can_estimate, residual=float("inf"), mesh=TriangleMesh(vertices, can_estimate.mesh.faces))
    with pytest.raises(FitFailedError, match=r"^its residual and mesh are not finite$"):
        check_finite(bad)


def test_a_surface_that_agrees_with_nothing_is_a_failure(can, decoder) -> None:
    (seen,) = can.observations((0.0,))
    noise = FitConfig(noise=replace(FitConfig().noise, huber=1e-9))  # no residual is an inlier
    with pytest.raises(FitFailedError, match="no measured depth agrees"):
        fit_object(views([seen], "can"), decoder, PLANE, noise)


@pytest.mark.parametrize("case", ["constant", "few", "none"])
def test_degenerate_depth_gives_finite_numbers_or_an_error(can, decoder, case) -> None:
    """A mask with one depth for all pixels, with measurements in few or in none of them."""
    (seen,) = can.observations((0.0,))
    depth = seen.frame.depth.copy()
    rows, columns = np.nonzero(seen.mask)
    kept = {"constant": len(rows), "few": 25, "none": 0}[case]
    depth[seen.mask] = 0.0
    depth[rows[:kept], columns[:kept]] = 0.45
    frame = replace(seen.frame, depth=depth)
    try:
        check_finite(fit_object(views([ObjectObservation(frame, seen.mask)], "can"), decoder, PLANE))
    except InvalidInputError as error:
        assert case != "constant" and "measured points" in str(error)


def status(can, scale=1.0, code=0.0, turn=0.0, inlier_ratio=0.9, converged=True, config=FitConfig()):
    pose = ObjectPose(so3_exp(np.array([turn, 0, 0])), can.pose.translation, scale * can.pose.scale)
    state = FitState(pose, np.full(16, code))
    evaluation = Evaluation(np.ones(1), np.ones((1, 25)), np.ones(1))
    return _status(Fit(state, evaluation, np.ones(1, bool), (), converged), PLANE, inlier_ratio, config)


def test_status(can) -> None:
    assert status(can) == "converged"
    assert status(can, converged=False) == "not_converged"
    assert status(can, turn=np.deg2rad(14)) == "converged"
    assert status(can, inlier_ratio=0.51) == "converged"
    for implausible in (
        {"scale": 0.19}, {"scale": 8.1}, {"code": 2.01}, {"turn": np.deg2rad(16)}, {"inlier_ratio": 0.49},
    ):  # fmt: skip
        assert status(can, **implausible) == "implausible", implausible
    leaning = FitConfig(max_tilt=np.deg2rad(40))
    assert status(can, turn=np.deg2rad(39), config=leaning) == "converged"
    assert status(can, turn=np.deg2rad(41), config=leaning) == "implausible"
