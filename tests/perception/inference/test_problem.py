"""Residuals, weights and Jacobian of the fit's least-squares problem."""

import numpy as np
import pytest

from perception.geometry import so3_exp, upright_rotation
from perception.inference.levenberg_marquardt import Evaluation
from perception.inference.observation import Crop, PixelConfig, SamplingRange, gather_pixels
from perception.inference.problem import (
    FitProblem,
    FitState,
    NoiseConfig,
    SizePrior,
    StepLimits,
    SupportCamera,
)
from perception.inference.shape_model import linearise
from perception.inference.yaw_prior import YawPrior
from perception.rendering.comparison import BACKDROP, render_silhouette
from perception.rendering.pose import ObjectPose, canonical_from_camera
from perception.rendering.renderer import render
from perception.types import SupportPlane

PLANE = SupportPlane()
PRIORS = 16 + 2 + 3 + 2 + 1  # code, scale ratios, size, tilt, support
NOISE = NoiseConfig(depth_sigma=0.004, huber=2.0, data_weight=0.1, code_prior=0.7)


@pytest.fixture(scope="module")
def can(make_table):
    return make_table("can", (0.5, -0.5), yaw=0.0)


@pytest.fixture(scope="module")
def shape(can, decoder):
    return linearise(decoder, "can", can.code)


def pixels_of(table, level: int = 0):
    sampling = SamplingRange(table.pose.translation, 0.1, 60)
    return gather_pixels(table.observations((0.3, 2.0)), sampling, Crop(16, level), PixelConfig())


def support_of(table):
    return SupportCamera.under(table.pose, PLANE, 0.04, 0.08)


def evaluated(table, shape, pose=None, code=None, noise=NOISE, level=0, **more):
    state = FitState(table.pose if pose is None else pose, table.code if code is None else code)
    pixels = pixels_of(table, level)
    return pixels, FitProblem(pixels, shape, support_of(table), noise, **more)(state)


def priors(evaluation: Evaluation) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Residuals and weights of each prior of a problem with a size prior."""
    ends = np.cumsum([0, 16, 2, 3, 2, 1])
    rows = evaluation.residuals[-PRIORS:], evaluation.weights[-PRIORS:]
    names = ("code", "ratio", "size", "tilt", "support")
    return {name: tuple(r[a:b] for r in rows) for name, a, b in zip(names, ends, ends[1:])}


def test_step_limits_follow_the_order_of_the_parameters():
    limits = StepLimits(code=1.0, rotation=2.0, translation=3.0, log_scale=4.0).vector
    np.testing.assert_array_equal(limits, [1.0] * 16 + [2.0] * 3 + [3.0] * 3 + [4.0] * 3)


def test_default_step_limits():
    assert StepLimits() == StepLimits(code=0.7, rotation=0.2, translation=0.02, log_scale=0.12)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("variance_counts", [True, False])
def test_render_rows_are_weighted_by_variance_huber_area_and_background(can, shape, level, variance_counts):
    """The formula of the weights, evaluated from the rendering itself."""
    noise = NoiseConfig(0.004, huber=2.0, rendered_variance=variance_counts, data_weight=0.1)
    pose = can.pose.moved(np.array([0, 0, 0, 0.006, 0, 0, 0, 0, 0.05]))  # some residuals beyond Huber's limit
    pixels, found = evaluated(can, shape, pose, noise=noise, level=level)
    image = render(shape.at(can.code), pixels.rays, canonical_from_camera(pose, pixels.Ts_world_camera))
    assert image.variance.max() > 20 * 0.004**2  # so that dropping it would show
    rows = np.column_stack([image.depth - pixels.target, image.variance, pixels.weight])
    residual, variance, weight = (rows if pixels.operator is None else pixels.operator @ rows).T
    sigma = np.sqrt(0.004**2 + (variance if variance_counts else 0))
    n_sigma = np.abs(residual) / sigma
    assert (n_sigma > 2).any() and (n_sigma < 2).any()
    expected = 0.1 * weight / sigma**2 * np.where(n_sigma > 2, 2 / np.maximum(n_sigma, 1e-12), 1.0)
    n = len(residual)
    np.testing.assert_allclose(found.residuals[:n], residual, atol=1e-7)
    np.testing.assert_allclose(found.weights[:n], expected, rtol=1e-4)
    assert len(found.residuals) == n + PRIORS - 3


def test_silhouettes_are_compared_with_the_mask(can, shape):
    pixels, found = evaluated(can, shape, renderer="silhouette")
    A = canonical_from_camera(can.pose, pixels.Ts_world_camera)
    image = render_silhouette(shape.at(can.code), pixels.rays, A)
    expected = image.depth - np.where(pixels.inside, 0.0, BACKDROP)
    np.testing.assert_allclose(found.residuals[: len(expected)], expected, atol=1e-7)


def test_code_prior_is_the_code_itself(can, shape):
    code = np.linspace(-0.1, 0.1, 16)
    residual, weight = priors(evaluated(can, shape, code=code, size=SizePrior(np.ones(3), 1.0))[1])["code"]
    np.testing.assert_array_equal(residual, code)
    np.testing.assert_array_equal(weight, 0.7)


def test_scale_priors(can, shape):
    scale = 0.05 * np.exp([0.1, 0.3, 0.5])
    pose = ObjectPose(can.pose.rotation, can.pose.translation, scale)
    noise = NoiseConfig(section_sigma=0.2, aspect_sigma=0.5)
    size = SizePrior(np.full(3, 0.05), 0.25)
    found = priors(evaluated(can, shape, pose, noise=noise, size=size)[1])
    np.testing.assert_allclose(found["ratio"][0], [0.1 - 0.3, 0.5 - (0.1 + 0.3) / 2], atol=1e-6)
    np.testing.assert_allclose(found["ratio"][1], [25.0, 4.0])
    np.testing.assert_allclose(found["size"][0], [0.1, 0.3, 0.5], atol=1e-6)
    np.testing.assert_allclose(found["size"][1], 16.0)


def test_tilt_prior_is_the_normal_in_the_object_frame(can, shape):
    pose = ObjectPose(so3_exp(np.array([0.1, 0, 0])), can.pose.translation, can.pose.scale)
    noise = NoiseConfig(tilt_sigma=0.05)
    residual, weight = priors(evaluated(can, shape, pose, noise=noise, size=SizePrior(np.ones(3), 1.0))[1])[
        "tilt"
    ]
    np.testing.assert_allclose(residual, [0, np.sin(0.1)], atol=1e-12)
    np.testing.assert_allclose(weight, 400.0)


def test_lying_objects_have_a_prior_of_the_angle_between_axis_and_plane(can, shape):
    """One row: sin(0.1) for an axis 0.1 rad above the plane, with the derivative of finite differences."""
    rotation = so3_exp(np.array([0.0, np.pi / 2 - 0.1, 0.0])) @ so3_exp(np.array([0.0, 0.0, 0.7]))
    pose = ObjectPose(rotation, can.pose.translation, can.pose.scale)
    pixels = pixels_of(can, 0)
    noise = NoiseConfig(lying_sigma=0.05)
    problem = FitProblem(pixels, shape, support_of(can), noise, resting="lying")
    row = -2  # before that of the support
    found = problem(FitState(pose, can.code))
    assert found.residuals[row] == pytest.approx(np.sin(0.1)) and found.weights[row] == pytest.approx(400.0)
    for k in range(3):
        step = np.zeros(9)
        step[k] = 1e-5
        moved = [problem(FitState(pose.moved(s * step), can.code)).residuals[row] for s in (1, -1)]
        assert found.jacobian[row, 16 + k] == pytest.approx((moved[0] - moved[1]) / 2e-5, abs=1e-4)


def test_support_prior_is_the_height_of_the_bottom(can, shape):
    size = SizePrior(np.ones(3), 1.0)
    heights = []
    for lift in (-0.004, 0.0, 0.004):
        pose = can.pose.moved(np.array([0, 0, 0, 0, 0, lift, 0, 0, 0]))
        residual, weight = priors(
            evaluated(can, shape, pose, noise=NoiseConfig(support_sigma=0.002), size=size)[1]
        )["support"]
        heights.append(float(residual[0]))
        np.testing.assert_allclose(weight, 0.002**-2)
    assert heights[1] == pytest.approx(0.0, abs=0.002)
    np.testing.assert_allclose(np.diff(heights), 0.004, atol=2e-4)


def test_an_object_out_of_the_lower_cameras_view_has_no_support_prior(can, shape):
    pose = can.pose.moved(np.array([0, 0, 0, 0.3, 0, 0, 0, 0, 0]))
    residual, weight = priors(evaluated(can, shape, pose, size=SizePrior(np.ones(3), 1.0))[1])["support"]
    assert residual == weight == 0.0


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.2, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_the_lower_camera_sees_a_square_of_the_plane_under_the_object(can, normal):
    n = np.array(normal) / np.linalg.norm(normal)
    plane = SupportPlane(n, 0.1)
    camera = SupportCamera.under(can.pose, plane, 0.05, 0.08, pixels=5)
    assert camera.plane is plane and camera.distance == pytest.approx(0.2)
    T = camera.T_world_camera
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(T[:3, 2], n, atol=1e-12)  # the optical axis is the normal
    points = camera.distance * camera.rays.directions @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(plane.height_above(points), 0, atol=1e-7)
    foot = can.pose.translation - plane.height_above(can.pose.translation[None])[0] * n
    np.testing.assert_allclose(points.mean(axis=0), foot, atol=1e-6)
    local = (points - foot) @ T[:3, :2]
    np.testing.assert_allclose([local.min(axis=0), local.max(axis=0)], [[-0.05] * 2, [0.05] * 2], atol=1e-6)
    np.testing.assert_allclose(camera.rays.depth_range, [[0.2 - 0.02, 0.2 + 0.06]])
    assert len(points) == 25 and camera.rays.samples == 64


def test_a_step_leads_from_one_state_to_another(can):
    rng = np.random.default_rng(0)
    start, step = FitState(can.pose, can.code), 0.1 * rng.standard_normal(25)
    moved = start.moved(step)
    np.testing.assert_allclose(moved.step_from(start), step, atol=1e-9)
    np.testing.assert_allclose(moved.code, start.code + step[:16])
    np.testing.assert_allclose(moved.pose.scale, start.pose.scale * np.exp(step[22:]))


@pytest.mark.parametrize(
    ("yaw", "angle", "weight"),
    [(0.45, 0.05, 0.9 / 0.2**2), (1.9, -0.1, 0.3 / 0.2**2), (1.4, -0.6, 0.2 / 0.2**2)],
)
def test_yaw_prior_is_the_angle_from_the_nearest_mode(can, shape, yaw, angle, weight):
    """Modes at 0.4 and 2.0; beyond two standard deviations the weight falls as Huber's."""
    modes = np.array([[np.cos(a), np.sin(a), 0.0] for a in (0.4, 2.0)])
    prior = YawPrior(modes, np.array([0.9, 0.3]))
    noise = NoiseConfig(yaw_sigma=0.2, huber=2.0)
    pose = ObjectPose(upright_rotation(PLANE.normal, yaw), can.pose.translation, can.pose.scale)
    _, found = evaluated(can, shape, pose, noise=noise, yaw=prior)
    assert found.residuals[-1] == pytest.approx(angle, abs=1e-6)
    assert found.weights[-1] == pytest.approx(weight, rel=1e-4)
    _, without = evaluated(can, shape, pose, noise=noise)
    assert len(found.residuals) == len(without.residuals) + 1


def test_derivative_of_the_yaw_prior_of_a_tilted_object(can, shape):
    prior = YawPrior(np.array([[1.0, 0.0, 0.0]]), np.ones(1))
    pose = ObjectPose(so3_exp(np.array([0.2, -0.3, 0.4])), can.pose.translation, can.pose.scale)
    problem = FitProblem(pixels_of(can), shape, support_of(can), NOISE, yaw=prior)
    state = FitState(pose, can.code)
    jacobian = problem(state).jacobian[-1]
    for k in range(25):
        step = np.zeros(25)
        step[k] = 1e-4
        ahead, behind = (problem(state.moved(sign * step)).residuals[-1] for sign in (1, -1))
        assert jacobian[k] == pytest.approx((ahead - behind) / 2e-4, abs=1e-5), k


@pytest.mark.parametrize("level", [0, 1])
def test_jacobian_equals_finite_differences(make_table, decoder, level):
    """All rows at once, with weights aside: renderings, priors, and the camera underneath."""
    table = make_table("mug", (0.3,), yaw=0.4)
    sampling = SamplingRange(table.pose.translation, 0.1, 300)
    pixels = gather_pixels(table.observations((0.0,)), sampling, Crop(24, level), PixelConfig())
    code = table.code + 0.1
    size = SizePrior(1.1 * table.pose.scale, 0.1)
    problem = FitProblem(pixels, linearise(decoder, "mug", code), support_of(table), NoiseConfig(), size)
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
        np.testing.assert_allclose(here.jacobian[-PRIORS:, k], numeric[-PRIORS:], atol=0.03, err_msg=str(k))
