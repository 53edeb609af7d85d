"""Depth residuals of the objects in a window, with their derivatives with respect to object and cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from perception.inference.levenberg_marquardt import Evaluation
from perception.inference.observation import Crop, PixelSet, SamplingRange, gather_pixels
from perception.inference.problem import FitProblem, FitState, SupportCamera
from perception.inference.shape_model import LinearisedShape
from perception.rendering.pose import object_by_camera
from perception.slam.bundle_window import BundleAdjustmentConfig, BundleWindow
from perception.slam.landmarks import Landmark
from perception.types import CODE_SIZE, GRID_RESOLUTION

CAMERA_SIZE = 6  # parameters of a camera: rotation, translation
_MIN_SUPPORT_HEIGHT = 0.04  # [m] depth range of the support camera, at least


@dataclass(frozen=True)
class ObjectEvaluation:
    """Residuals of one object: ``problem`` with respect to the object's 25 parameters.

    ``camera_jacobian`` is the derivative of the first n rows, the depth residuals, with respect to the pose
    of the camera that each belongs to.
    """

    problem: Evaluation
    camera_jacobian: Float[np.ndarray, "n 6"]


@dataclass(frozen=True)
class WindowState:
    """Parameters of a window: states of the objects by id, and camera poses."""

    objects: dict[int, FitState]
    Ts_world_camera: Float[np.ndarray, "k 4 4"]


@dataclass(frozen=True)
class WindowEvaluation:
    """Residuals at one state: of the objects in the order of their ids, and of the plane in each keyframe."""

    objects: list[ObjectEvaluation]
    planes: list[Evaluation]


class ObjectInWindow:
    """One object's pixels in all keyframes that observe it, and their least-squares problem.

    Attributes:
        views: Indices in the window of the keyframes that observe the object.
        pixels: Pixels of all views.
    """

    def __init__(
        self, landmark: Landmark, views: list[int], window: BundleWindow, config: BundleAdjustmentConfig
    ) -> None:
        self.views, self.noise = views, config.noise
        pose = landmark.state.pose
        voxel = 2 * float(pose.scale.max()) / GRID_RESOLUTION
        step = landmark.sample_step * voxel
        sampling = SamplingRange.around(pose.translation, landmark.bounding_radius, step)
        observations = [window.keyframes[k].observation(landmark.id) for k in views]
        self.pixels: PixelSet = gather_pixels(observations, sampling, Crop(config.crop), config.pixels)
        height = max(2 * pose.scale[2], _MIN_SUPPORT_HEIGHT)
        half_width = pose.scale.max()
        self.support = SupportCamera.under(pose, window.plane, half_width, height, config.support_pixels)

    def evaluate(
        self, state: FitState, shape: LinearisedShape, Ts_world_camera: Float[np.ndarray, "k 4 4"]
    ) -> ObjectEvaluation:
        """Return residuals, weights and Jacobians at a state of the object and the cameras."""
        Ts = Ts_world_camera[self.views]
        pixels = replace(self.pixels, Ts_world_camera=Ts)
        evaluation = FitProblem(pixels, shape, self.support, self.noise)(state)
        n = len(pixels.target)
        by_pose = evaluation.jacobian[:n, CODE_SIZE : CODE_SIZE + CAMERA_SIZE]
        camera_jacobian = np.empty((n, CAMERA_SIZE))
        for k, T in enumerate(Ts):
            own = pixels.rays.view == k
            camera_jacobian[own] = by_pose[own] @ object_by_camera(state.pose, T)
        return ObjectEvaluation(evaluation, camera_jacobian)
