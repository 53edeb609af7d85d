"""Problem, settings and result of the joint optimisation of a window of keyframes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from perception.inference.levenberg_marquardt import LmConfig
from perception.inference.observation import PixelConfig
from perception.inference.problem import NoiseConfig, StepLimits
from perception.slam.keyframes import Keyframe
from perception.slam.landmarks import Landmark
from perception.slam.marginal_prior import MarginalPrior, ViewInformation
from perception.types import SupportPlane


@dataclass(frozen=True)
class BundleAdjustmentConfig:
    """Budget, weights and priors of the joint optimisation.

    Attributes:
        window_size: Number of keyframes in a window.
        crop: Pixels along the longer side of each object's crop.
        max_iterations: Number of Levenberg-Marquardt iterations.
        support_pixels: Side of the virtual support camera's image, in pixels.
        relinearise_distance: Distance of a code from its linearisation beyond which it is decoded again.
        lm: Damping.
        noise: Weights of the residuals.
        pixels: Selection of pixels.
        step_limits: Limits of the objects' steps in one iteration; the cameras' steps are scaled with them.
        max_prior_views: Total weight of keyframes outside the window in a landmark's prior, in views.
        camera_prior_weight: Factor on the information of the camera poses' priors; compensates for the larger
            data weight here than in tracking.
        camera_sigma: Standard deviation that keyframes' poses are marginalised with (rotation, translation),
            where the pose was not better known when the frame was taken, in radians and metres.
        plane_sigma: Standard deviation of a plane point's height, in metres.
        use_plane: Whether the support plane constrains the cameras.
        threads: Number of objects that are evaluated in parallel.
    """

    window_size: int = 3
    crop: int = 24
    max_iterations: int = 6
    support_pixels: int = 8
    relinearise_distance: float = 1.5
    lm: LmConfig = field(default_factory=lambda: LmConfig(damping=1e-2))
    noise: NoiseConfig = field(default_factory=lambda: NoiseConfig(data_weight=0.2))
    pixels: PixelConfig = field(default_factory=PixelConfig)
    step_limits: StepLimits = field(default_factory=StepLimits)
    max_prior_views: float = 4.0
    camera_prior_weight: float = 4.0
    camera_sigma: Float[np.ndarray, "6"] = field(default_factory=lambda: np.repeat([0.005, 0.003], 3))
    plane_sigma: float = 0.005
    use_plane: bool = True
    threads: int = 2


@dataclass(frozen=True)
class BundleWindow:
    """The problem that is optimised.

    Attributes:
        keyframes: Keyframes of the window; the first is fixed.
        landmarks: Landmarks of the map; those that no keyframe observes are ignored.
        plane: Support plane in the world frame.
        plane_points: Measured points of the plane in the camera frame of each keyframe, in metres.
        priors: Priors on landmarks from keyframes outside the window. They preserve the shape of parts that
            the window does not show.
    """

    keyframes: Sequence[Keyframe]
    landmarks: Mapping[int, Landmark]
    plane: SupportPlane
    plane_points: Sequence[Float[np.ndarray, "_n 3"]]
    priors: Mapping[int, MarginalPrior] = field(default_factory=dict)


@dataclass(frozen=True)
class BundleResult:
    """The window after optimisation.

    Attributes:
        keyframes: Keyframes with optimised poses.
        landmarks: Optimised landmarks by id.
        information: Information on a landmark by (keyframe number, landmark id).
        cost_before: Cost at the start.
        cost_after: Cost at the end, with the weights of the last linearisation.
        iterations: Number of iterations, rejected ones included.
    """

    keyframes: tuple[Keyframe, ...]
    landmarks: Mapping[int, Landmark]
    information: Mapping[tuple[int, int], ViewInformation]
    cost_before: float
    cost_after: float
    iterations: int
