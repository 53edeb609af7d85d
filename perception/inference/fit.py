"""Shape and pose of one object from its views: MAP estimate by Levenberg-Marquardt, coarse to fine.

NodeSLAM, section "Object Shape and Pose Inference": the code is decoded to a grid, the grid rendered into
every view, and the weighted difference to the measured depth moves code and 9-DoF pose.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from perception.errors import InvalidInputError
from perception.geometry import invert
from perception.inference.initialise import initial_poses
from perception.inference.levenberg_marquardt import Evaluation, LmConfig, LmIteration, minimise
from perception.inference.meshing import MeshConfig, mesh_from_grid
from perception.inference.observation import (
    ObjectObservation,
    PixelConfig,
    PixelSet,
    gather_pixels,
    ray_samples,
    sampling_radius,
)
from perception.inference.problem import FitProblem, FitState, NoiseConfig, StepLimits, SupportCamera
from perception.inference.refine import RefineConfig, refine_mesh
from perception.inference.shape_model import (
    Decoder,
    LinearisedShape,
    decode_with_jacobian,
    linearise,
    mean_shape,
)
from perception.inference.uncertainty import surface_band
from perception.rendering.comparison import RendererName
from perception.rendering.pose import ObjectPose
from perception.types import CODE_SIZE, GRID_RESOLUTION, Category, FitStatus, ObjectEstimate, SupportPlane

logger = logging.getLogger(__name__)

SETTLED = 0.5  # root mean square of the last movements, in standard deviations, that counts as standing still


@dataclass(frozen=True)
class Stage:
    """Iterations at one crop size [pixel] and pyramid level (how often residuals are blurred and halved)."""

    crop: int
    level: int
    iterations: int


@dataclass(frozen=True)
class FitConfig:
    """How a fit is run. The first stage is run for every yaw hypothesis, the others for the best of them."""

    # Length of the renderer's steps along a ray [voxel], by class. A grid's rendered surface lies behind the
    # true one for long steps, in front of it for short ones; where they agree depends on walls and blur.
    step: Mapping[Category, float] = field(
        default_factory=lambda: {"mug": 0.55, "bowl": 0.4, "bottle": 0.65, "can": 0.65}
    )
    stages: tuple[Stage, ...] = (Stage(32, 1, 8), Stage(36, 0, 12), Stage(64, 0, 10))
    renderer: RendererName = "probabilistic"
    start_views: int | None = None  # how many views the start is taken from; all by default
    relinearise_every: int = 4
    settled_over: int = 8  # iterations over which a converged fit stands still
    pixels: PixelConfig = field(default_factory=lambda: PixelConfig(sparse_background=True))
    reference_crop: int = 48  # a pixel's weight is 1 there; those of finer crops say no more in all
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    lm: LmConfig = field(default_factory=LmConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    full_views: int = 3  # so many views have crops of full size; more share those views' number of pixels
    threads: int = 1  # cores that one fit renders on
    refine: RefineConfig | None = field(default_factory=RefineConfig)  # None leaves the mesh as decoded
    step_limits: StepLimits = field(default_factory=StepLimits)


@dataclass(frozen=True)
class Fit:
    """A fit before it becomes an ObjectEstimate."""

    state: FitState
    evaluation: Evaluation
    residual_object: Float[np.ndarray, "n"]
    residual_background: Float[np.ndarray, "b"]
    trace: tuple[LmIteration, ...]
    converged: bool


@dataclass(frozen=True)
class FitStep:
    """Where a fit stands, for those who watch it.

    Attributes:
        iteration: of the optimiser, 0 before the first.
        pose, code: of the object so far.
        residual: mean capped depth residual in [m]; NaN before the first iteration.
    """

    iteration: int
    pose: ObjectPose
    code: Float[np.ndarray, "16"]
    residual: float


OnStep = Callable[[FitStep], None]


def fit_object(
    observations: Sequence[ObjectObservation],
    category: Category,
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig | None = None,
    object_id: int = 0,
    score: float = 1.0,
    on_step: OnStep | None = None,
) -> ObjectEstimate:
    """Reconstructs one object.

    Args:
        observations: its views, at least one.
        category: its class.
        decoder: the shape prior.
        plane: what it stands on, in the world.
        config: budget and weights.
        object_id: for the estimate.
        score: class confidence, for the estimate.
        on_step: is told how the fit goes on.

    Raises:
        InvalidInputError: no view shows anything of the object above the plane.
    """
    config = config or FitConfig()
    fit = optimise_object(observations, category, decoder, plane, config, on_step)
    return _estimate(fit, observations, category, decoder, plane, config, object_id, score)


def optimise_object(
    observations: Sequence[ObjectObservation],
    category: Category,
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig | None = None,
    on_step: OnStep | None = None,
) -> Fit:
    """The iterations of ``fit_object`` alone: pose and code, nothing meshed."""
    if not observations:
        raise InvalidInputError(f"a {category} without any view cannot be reconstructed")
    return _Fitter(observations, category, decoder, plane, config or FitConfig(), on_step).run()


_Standing = tuple[Fit, LinearisedShape, float]  # a fit, the shape it was last linearised at, its damping


class _Fitter:
    """The stages of one fit; the decoder's linearisation is shared by the hypotheses while codes agree."""

    def __init__(self, observations, category, decoder, plane, config, on_step: OnStep | None) -> None:
        self.observations, self.plane, self.config = observations, plane, config
        self.on_step = on_step or (lambda step: None)
        self.linearise = lambda code: linearise(decoder, category, code, config.threads)
        self.mean_shape = mean_shape(decoder, category)
        self.poses, size = initial_poses(observations[: config.start_views], category, plane)
        self.voxel = 2 * float(self.poses[0].scale[0]) / GRID_RESOLUTION
        self.reach = sampling_radius(size.bounding_radius)
        self.support = SupportCamera.under(self.poses[0], plane, 1.2 * size.radius, max(size.height, 0.04))
        step = config.step[category]
        self.size_sigma = config.noise.mug_size_sigma if category == "mug" else config.noise.size_sigma
        self.samples = ray_samples(self.reach, step * self.voxel)

    def run(self) -> Fit:
        (first, coarse), *others = [(stage, self._pixels(stage)) for stage in self.config.stages]
        starts = [FitState(pose, np.zeros(CODE_SIZE)) for pose in self.poses]
        self.on_step(FitStep(0, starts[0].pose, starts[0].code, float("nan")))
        damping = self.config.lm.damping
        fits = [self._stage(first, coarse, state, self.mean_shape, damping) for state in starts]
        best, shape, damping = self._best(fits, others[0][1] if others else coarse)
        self.on_step(FitStep(len(best.trace), best.state.pose, best.state.code, _misfit(best)))
        for stage, pixels in others:
            fit, shape, damping = self._stage(stage, pixels, best.state, shape, damping, len(best.trace))
            best = replace(fit, trace=best.trace + fit.trace)
        return best

    def _best(self, fits: Sequence[_Standing], pixels: PixelSet) -> _Standing:
        """The hypothesis that agrees best with pixels that are not blurred: handles are thin."""

        def misfit(standing: _Standing) -> float:
            fit, shape, _ = standing
            residuals = self._problem(pixels, shape)(fit.state).residuals
            return _capped_mean(residuals[: len(pixels.is_object)])

        return fits[0] if len(fits) == 1 else min(fits, key=misfit)

    def _problem(self, pixels: PixelSet, shape: LinearisedShape) -> FitProblem:
        noise, renderer = self.config.noise, self.config.renderer
        scale = self.poses[0].scale
        return FitProblem(pixels, shape, self.plane, self.support, noise, scale, self.size_sigma, renderer)

    def _pixels(self, stage: Stage) -> PixelSet:
        shrink = min(1.0, np.sqrt(self.config.full_views / len(self.observations)))
        return gather_pixels(
            self.observations,
            self.poses[0].translation,
            self.reach,
            self.samples,
            round(shrink * stage.crop),
            stage.level,
            self.config.pixels,
            self.config.threads,
            None if stage.level else round(shrink * self.config.reference_crop),
        )

    def _stage(
        self,
        stage: Stage,
        pixels: PixelSet,
        state: FitState,
        shape: LinearisedShape,
        damping: float,
        watched_from: int | None = None,
    ) -> _Standing:
        config = self.config
        limit = config.step_limits.vector
        trace: tuple[LmIteration, ...] = ()
        history = [(0, state)]
        left = stage.iterations
        while True:
            budget = min(left, config.relinearise_every)
            lm = replace(config.lm, max_iterations=budget, damping=damping)
            result = minimise(self._problem(pixels, shape), FitState.moved, state, lm, limit)
            state, damping, trace = result.state, result.damping, trace + result.trace
            history.append((len(trace), state))
            if watched_from is not None:
                misfit = _capped_mean(result.evaluation.residuals[: len(pixels.is_object)])
                self.on_step(FitStep(watched_from + len(trace), state.pose, state.code, misfit))
            left -= max(len(result.trace), 1)
            if left <= 0 or result.status in ("stuck", "not_finite"):
                break
            if result.status == "converged" and np.allclose(state.code, shape.code, atol=1e-3):
                break
            shape = self.linearise(state.code)
        hessian, _ = result.evaluation.normal_equations()
        since = next(s for n, s in history if n >= len(trace) - config.settled_over)
        converged = _settled(state.step_from(since), hessian)
        residual = result.evaluation.residuals[: len(pixels.is_object)]
        on, off = residual[pixels.is_object], residual[~pixels.is_object]
        return Fit(state, result.evaluation, on, off, trace, converged), shape, damping


def _settled(step: Float[np.ndarray, "25"], hessian: Float[np.ndarray, "25 25"]) -> bool:
    """Whether the last iterations moved the estimate by little, measured by its own standard deviations."""
    return bool(step @ hessian @ step < SETTLED**2 * len(step))


def _misfit(fit: Fit) -> float:
    """Whatever variance it renders."""
    return _capped_mean(np.concatenate([fit.residual_object, fit.residual_background]))


def _capped_mean(residuals: Float[np.ndarray, "n"]) -> float:
    """Mean absolute residual in [m], single ones capped."""
    return float(np.mean(np.minimum(np.abs(residuals), 0.03)))


def _estimate(
    fit: Fit,
    observations: Sequence[ObjectObservation],
    category: Category,
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig,
    object_id: int,
    score: float,
) -> ObjectEstimate:
    pose, code = fit.state.pose, fit.state.code
    grid, jacobian = decode_with_jacobian(decoder, category, code, config.threads)
    mesh = mesh_from_grid(grid, pose.scale, category, config.mesh)
    determined = np.zeros(len(mesh.vertices))
    if config.refine is not None:
        refined = refine_mesh(mesh.transformed(pose.T_world_object), observations, plane, config.refine)
        mesh, determined = refined.mesh.transformed(invert(pose.T_world_object)), refined.determined
    hessian, _ = fit.evaluation.normal_equations()
    inliers = np.abs(fit.residual_object) < config.noise.huber * config.noise.depth_sigma
    residual = float(np.sqrt(np.mean(fit.residual_object[inliers] ** 2))) if inliers.any() else float("inf")
    covariance = np.linalg.pinv(hessian, hermitian=True)
    estimate = ObjectEstimate(
        id=object_id,
        category=category,
        code=code,
        T_world_object=pose.T_world_object,
        scale=pose.scale,
        mesh=mesh,
        score=score,
        n_views=len(observations),
        residual=residual,
        status=_status(fit, pose, plane, float(inliers.mean()) if inliers.size else 0.0),
        covariance=covariance,
    )
    return replace(estimate, surface_sigma=surface_band(estimate, covariance, determined, grid, jacobian))


def _status(fit: Fit, pose: ObjectPose, plane: SupportPlane, inlier_share: float) -> FitStatus:
    tilt = np.arccos(np.clip(pose.rotation[:, 2] @ plane.normal, -1, 1))
    plausible = (
        inlier_share > 0.5
        and pose.scale.min() > 0.01
        and pose.scale.max() < 0.4
        and np.linalg.norm(fit.state.code) < 8.0
        and tilt < np.deg2rad(15)
        and np.isfinite(fit.evaluation.cost)
    )
    if not plausible:
        return "implausible"
    return "converged" if fit.converged else "not_converged"
