"""Settings of a fit: stages from coarse to fine, weights, rendering and meshing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from perception.inference.levenberg_marquardt import LmConfig
from perception.inference.meshing import MeshConfig
from perception.inference.observation import PixelConfig
from perception.inference.problem import NoiseConfig, StepLimits
from perception.inference.refine import RefineConfig
from perception.rendering.comparison import RendererName
from perception.types import Category, RestingPose


@dataclass(frozen=True)
class FitStage:
    """Iterations at one resolution.

    Attributes:
        crop: Pixels along the longer side of the crop.
        level: Pyramid level: number of times the residuals are blurred and halved.
        iterations: Number of Levenberg-Marquardt iterations.
    """

    crop: int
    level: int
    iterations: int


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit.

    The first stage is run for every yaw hypothesis, the second for the best few, the others for the best.

    Attributes:
        step: Length of a render step along a ray, in voxels, by class. The rendered surface of a grid lies
            behind the true one for long steps and in front of it for short ones; the unbiased length depends
            on wall thickness and blur.
        stages: Iterations from coarse to fine.
        beam: Largest number of yaw hypotheses that reach the second stage, by class. Only handles make more
            than one worth the time.
        beam_ratio: Largest cost of such a hypothesis relative to the best one.
        renderer: Renderer that predicts the depth.
        start_views: Number of leading views that give the initial pose; None for all.
        relinearise_every: Iterations between two evaluations of the decoder's Jacobian.
        settled_over: Iterations over which a converged fit must have settled.
        pixels: Selection and weights of the pixels.
        reference_crop: Crop at which a pixel has weight 1, so that finer crops do not add information.
        noise: Standard deviations and weights of the residuals.
        lm: Damping schedule.
        mesh: Surface extraction.
        full_views: Number of views with crops of full size; more views share the same number of pixels.
        threads: Number of cores that render one fit.
        refine: Refinement of the mesh on the measurements; None leaves the decoded surface.
        step_limits: Largest step of each parameter in one iteration.
        resting: Resting pose that is assumed: initial poses and the prior of the tilt.
        toward: Direction, levelled, in which the axis of a lying object starts; None for any in the pose.
        max_tilt: Largest angle of a plausible object's axis to its direction in that pose, in radians.
    """

    step: Mapping[Category, float] = field(
        default_factory=lambda: {"mug": 0.55, "bowl": 0.4, "bottle": 0.65, "can": 0.65}
    )
    stages: tuple[FitStage, ...] = (FitStage(32, 1, 8), FitStage(36, 0, 12), FitStage(64, 0, 10))
    beam: Mapping[Category, int] = field(default_factory=lambda: {"mug": 4, "bowl": 1, "bottle": 1, "can": 1})
    beam_ratio: float = 3.0
    renderer: RendererName = "probabilistic"
    start_views: int | None = None
    relinearise_every: int = 4
    settled_over: int = 8
    pixels: PixelConfig = field(default_factory=lambda: PixelConfig(sparse_background=True))
    reference_crop: int = 48
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    lm: LmConfig = field(default_factory=LmConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    full_views: int = 3
    threads: int = 1
    refine: RefineConfig | None = field(default_factory=RefineConfig)
    step_limits: StepLimits = field(default_factory=StepLimits)
    resting: RestingPose = "upright"
    toward: tuple[float, float, float] | None = None
    max_tilt: float = math.radians(15)
