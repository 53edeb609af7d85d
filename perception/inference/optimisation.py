"""Shape and pose of one object from its views: MAP estimate by Levenberg-Marquardt, coarse to fine.

NodeSLAM, section "Object Shape and Pose Inference": the code is decoded to a grid, the grid is rendered into
every view, and the weighted difference from the measured depth corrects the code and the 9-DoF pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from perception.errors import InvalidInputError
from perception.inference.fit_config import FitConfig, FitStage
from perception.inference.levenberg_marquardt import Evaluation, LmIteration, LmResult, minimise
from perception.inference.observation import Crop, ObjectViews, PixelSet, SamplingRange, gather_pixels
from perception.inference.problem import FitProblem, FitState, SizePrior, SupportCamera
from perception.inference.resting import initial_resting_poses
from perception.inference.shape_model import Decoder, LinearisedShape, linearise, mean_shape
from perception.inference.warm_start import warm_start
from perception.inference.yaw_prior import YawPrior, yaw_prior
from perception.rendering.pose import ObjectPose
from perception.types import CODE_SIZE, GRID_RESOLUTION, SupportPlane

# Root mean square of the last movements, in standard deviations, below which a fit has settled.
SETTLED = 0.5
LYING_BEAM = 4  # hypotheses of a lying object that reach the second stage: two directions, two rolls
RESIDUAL_CAP = 0.03  # [m] largest contribution of one residual to the reported mean


@dataclass(frozen=True)
class FitStart:
    """Initial poses of a fit, and what stays fixed over its iterations.

    Attributes:
        poses: Initial poses, one per hypothesis of the orientation, the most probable first.
        sampling: Depth range of the rays.
        support: Virtual camera under the object.
        size: Prior on the scale.
        yaw: Prior on the direction of a mug's handle.
    """

    poses: tuple[ObjectPose, ...]
    sampling: SamplingRange
    support: SupportCamera
    size: SizePrior
    yaw: YawPrior | None

    @staticmethod
    def of(views: ObjectViews, plane: SupportPlane, config: FitConfig) -> FitStart:
        """Measure the masked clouds; raises InvalidInputError if none has points above the plane."""
        category, noise = views.category, config.noise
        seen = views.observations[: config.start_views]
        toward = None if config.toward is None else np.array(config.toward)
        poses, cloud = initial_resting_poses(seen, category, plane, config.resting, toward)
        scale, centre = poses[0].scale, poses[0].translation
        voxel = 2 * float(scale[0]) / GRID_RESOLUTION
        return FitStart(
            poses=tuple(poses),
            sampling=SamplingRange.around(centre, cloud.bounding_radius, config.step[category] * voxel),
            support=SupportCamera.under(poses[0], plane, 1.2 * cloud.radius, max(cloud.height, 0.04)),
            size=SizePrior(scale, noise.mug_size_sigma if category == "mug" else noise.size_sigma),
            yaw=yaw_prior(seen, plane) if (category, config.resting) == ("mug", "upright") else None,
        )


@dataclass(frozen=True)
class Fit:
    """Result of the optimisation, before meshing.

    Attributes:
        state: Pose and code.
        evaluation: Residuals, Jacobian and weights at ``state``.
        inside: For each render residual whether its pixel shows the object (or the background).
        trace: All iterations of the winning hypothesis.
        converged: Whether the last iterations moved the estimate little in terms of its standard deviations.
    """

    state: FitState
    evaluation: Evaluation
    inside: Bool[np.ndarray, "n"]
    trace: tuple[LmIteration, ...]
    converged: bool

    @property
    def residual_object(self) -> Float[np.ndarray, "k"]:
        """Depth residuals of the object's pixels, in metres."""
        return self.evaluation.residuals[: len(self.inside)][self.inside]

    @property
    def residual_background(self) -> Float[np.ndarray, "b"]:
        """Depth residuals of the background's pixels, in metres."""
        return self.evaluation.residuals[: len(self.inside)][~self.inside]


@dataclass(frozen=True)
class FitStep:
    """Progress of a fit.

    Attributes:
        iteration: Number of iterations done; 0 at the initial state.
        pose: Current pose.
        code: Current code.
        residual: Mean capped depth residual, in metres; NaN at the initial state.
    """

    iteration: int
    pose: ObjectPose
    code: Float[np.ndarray, "16"]
    residual: float


OnStep = Callable[[FitStep], None]


def optimise_object(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig = FitConfig(),
    on_step: OnStep | None = None,
) -> Fit:
    """Estimate pose and code of one object, without a mesh.

    Args:
        views: Observations of the object, at least one, with its class.
        decoder: Shape prior.
        plane: Support plane of the object, in the world frame.
        config: Budget and weights.
        on_step: Called with the progress of the fit.

    Raises:
        InvalidInputError: No view is given, or none shows any point of the object above the plane.
    """
    if not views.observations:
        raise InvalidInputError(f"a {views.category} without any view cannot be reconstructed")
    return _Fitter(views, decoder, plane, config, on_step).run()


def coarse_residual(
    views: ObjectViews, decoder: Decoder, plane: SupportPlane, config: FitConfig = FitConfig(), most: int = 6
) -> float:
    """Return the mean capped depth residual in metres after the first stage alone: how near a shape comes.

    Args:
        views: Observations of the object, with its class.
        decoder: Shape prior.
        plane: Support plane of the object.
        config: Budget and weights.
        most: Largest number of initial poses, spread over all.

    Raises:
        InvalidInputError: No view is given, or none shows any point of the object above the plane.
    """
    fitter = _Fitter(views, decoder, plane, replace(config, stages=config.stages[:1]), None)
    poses = fitter.start.poses
    fitter.start = replace(fitter.start, poses=poses[:: -(-len(poses) // most)])
    return _misfit(fitter.run())


@dataclass(frozen=True)
class _Candidate:
    """A fit that can be continued: with the linearisation of its shape and its damping."""

    fit: Fit
    shape: LinearisedShape
    damping: float


class _Fitter:
    """The stages of one fit; hypotheses share the decoder's linearisation at the mean code."""

    def __init__(
        self,
        views: ObjectViews,
        decoder: Decoder,
        plane: SupportPlane,
        config: FitConfig,
        on_step: OnStep | None,
    ) -> None:
        self.views, self.decoder, self.config, self.on_step = views, decoder, config, on_step
        self.start = FitStart.of(views, plane, config)

    def run(self) -> Fit:
        config, views = self.config, self.views
        start = warm_start(views.start, views.category, config.resting, self.start.poses)
        return self._from_nothing() if start is None else self._from(start)

    def _from(self, start: FitState) -> Fit:
        """Run the last stage alone."""
        self._report(0, start, float("nan"))
        shape = linearise(self.decoder, self.views.category, start.code, self.config.threads)
        last = self.config.stages[-1]
        return self._stage(last, self._pixels(last), start, shape, self.config.lm.damping, 0).fit

    def _from_nothing(self) -> Fit:
        first, *others = self.config.stages
        coarse, finer = self._pixels(first), [self._pixels(stage) for stage in others]
        starts = [FitState(pose, np.zeros(CODE_SIZE)) for pose in self.start.poses]
        self._report(0, starts[0], float("nan"))
        mean, damping = mean_shape(self.decoder, self.views.category), self.config.lm.damping
        candidates = [self._stage(first, coarse, state, mean, damping) for state in starts]
        candidates = self._likeliest(candidates, finer[0] if finer else coarse)
        best = candidates[0]
        self._report(len(best.fit.trace), best.fit.state, _misfit(best.fit))
        for stage, pixels in zip(others, finer, strict=True):
            alone = len(candidates) == 1
            candidates = [self._continued(candidate, stage, pixels, alone) for candidate in candidates]
            candidates = self._likeliest(candidates, pixels)[:1]
        return candidates[0].fit

    def _report(self, iteration: int, state: FitState, residual: float) -> None:
        if self.on_step is not None:
            self.on_step(FitStep(iteration, state.pose, state.code, residual))

    def _likeliest(self, candidates: Sequence[_Candidate], pixels: PixelSet) -> list[_Candidate]:
        """Return the hypotheses of least cost, the best first, at most the beam of the class.

        The cost weights residuals by the rendered variance: a handle rendered where the background is
        measured, or missing where it is measured, outweighs the blur of a surface that is not yet fitted.
        Unblurred pixels, because handles are thin.
        """
        if len(candidates) == 1:
            return list(candidates)
        cost = [self._problem(pixels, c.shape)(c.fit.state).cost for c in candidates]
        order = sorted(range(len(candidates)), key=cost.__getitem__)
        most = self.config.beam[self.views.category]
        if self.config.resting == "lying":
            most = max(most, LYING_BEAM)
        limit = self.config.beam_ratio * cost[order[0]]
        return [candidates[order[0]], *(candidates[k] for k in order[1:most] if cost[k] <= limit)]

    def _continued(
        self, candidate: _Candidate, stage: FitStage, pixels: PixelSet, reported: bool
    ) -> _Candidate:
        """Return a candidate after one more stage."""
        before = candidate.fit
        done = len(before.trace) if reported else None
        after = self._stage(stage, pixels, before.state, candidate.shape, candidate.damping, done)
        return replace(after, fit=replace(after.fit, trace=before.trace + after.fit.trace))

    def _problem(self, pixels: PixelSet, shape: LinearisedShape) -> FitProblem:
        config, start = self.config, self.start
        return FitProblem(
            pixels, shape, start.support, config.noise, start.size, start.yaw, config.renderer, config.resting
        )

    def _pixels(self, stage: FitStage) -> PixelSet:
        config = self.config
        shrink = min(1.0, np.sqrt(config.full_views / len(self.views.observations)))
        reference = None if stage.level else round(shrink * config.reference_crop)
        crop = Crop(round(shrink * stage.crop), stage.level, reference)
        return gather_pixels(
            self.views.observations, self.start.sampling, crop, config.pixels, config.threads
        )

    def _stage(
        self,
        stage: FitStage,
        pixels: PixelSet,
        state: FitState,
        shape: LinearisedShape,
        damping: float,
        done: int | None = None,
    ) -> _Candidate:
        """Run the iterations of one stage.

        Args:
            stage: Number of iterations.
            pixels: Measurements at the stage's resolution.
            state: Initial pose and code.
            shape: Linearisation of the decoder near the initial code.
            damping: Initial damping.
            done: Iterations before this stage, for progress; None runs it without reports.
        """
        config, limits = self.config, self.config.step_limits.vector
        trace: tuple[LmIteration, ...] = ()
        history = [(0, state)]
        left = stage.iterations
        while True:
            budget = min(left, config.relinearise_every)
            lm = replace(config.lm, max_iterations=budget, damping=damping)
            result = minimise(self._problem(pixels, shape), FitState.moved, state, lm, limits)
            state, damping, trace = result.state, result.damping, trace + result.trace
            history.append((len(trace), state))
            if done is not None:
                residuals = result.evaluation.residuals[: len(pixels.is_object)]
                self._report(done + len(trace), state, _capped_mean(residuals))
            left -= max(len(result.trace), 1)
            if left <= 0 or _finished(result, shape):
                break
            shape = linearise(self.decoder, self.views.category, state.code, config.threads)
        hessian, _ = result.evaluation.normal_equations()
        since = next(s for n, s in history if n >= len(trace) - config.settled_over)
        converged = _settled(state.step_from(since), hessian)
        return _Candidate(Fit(state, result.evaluation, pixels.is_object, trace, converged), shape, damping)


def _finished(result: LmResult[FitState], shape: LinearisedShape) -> bool:
    """Return whether more iterations are pointless: converged at the linearisation's code, or failed."""
    if result.status in ("stuck", "not_finite"):
        return True
    return result.status == "converged" and np.allclose(result.state.code, shape.code, atol=1e-3)


def _settled(step: Float[np.ndarray, "25"], hessian: Float[np.ndarray, "25 25"]) -> bool:
    """Return whether a step is small, measured in the estimate's own standard deviations."""
    return bool(step @ hessian @ step < SETTLED**2 * len(step))


def _misfit(fit: Fit) -> float:
    """Return the mean capped residual of all pixels, in metres, independent of the rendered variance."""
    return _capped_mean(np.concatenate([fit.residual_object, fit.residual_background]))


def _capped_mean(residuals: Float[np.ndarray, "n"]) -> float:
    """Return the mean absolute residual, in metres, with each capped at ``RESIDUAL_CAP``."""
    return float(np.mean(np.minimum(np.abs(residuals), RESIDUAL_CAP)))
