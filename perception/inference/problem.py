"""Least-squares problem of a fit: render residuals, code and scale priors, and the support plane.

The 25 parameters, in this order: code (16), rotation (3, object frame), translation (3, world frame),
log scale (3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.geometry import hat, rigid, so3_log
from perception.inference.levenberg_marquardt import Evaluation
from perception.inference.observation import PixelSet
from perception.inference.shape_model import LinearisedShape
from perception.inference.yaw_prior import YawPrior
from perception.rendering.comparison import BACKDROP, RENDERERS, RendererName
from perception.rendering.pose import (
    POSE_SIZE,
    ObjectPose,
    canonical_from_camera,
    map_jacobian,
    pose_jacobian,
)
from perception.rendering.renderer import RayBundle, Rendering, ShapeGrid, render
from perception.types import CODE_SIZE, RestingPose, SupportPlane

PARAMETERS = CODE_SIZE + POSE_SIZE
_CODE, _TURN, _SCALE = slice(0, 16), slice(16, 19), slice(22, 25)


@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations and weights of the residuals.

    Attributes:
        depth_sigma: Standard deviation of a depth residual, in metres, in addition to the rendered variance.
        huber: Huber threshold, in standard deviations; larger residuals are weighted linearly.
        rendered_variance: Whether the rendered variance is added to the variance of a depth residual.
        data_weight: Weight of all render residuals relative to the priors.
        code_prior: Weight of the squared code.
        tilt_sigma: Standard deviation of the angle between the object's axis and the plane's normal, in rad.
        lying_sigma: Standard deviation of the angle between the axis of a lying object and the plane, in rad;
            the walls of mugs and bottles are not parallel to the axis.
        support_sigma: Standard deviation of the height of the object's lowest part over the plane, in metres.
        size_sigma: Standard deviation of the log scale from the size of the observed cloud.
        mug_size_sigma: The same for mugs, whose handle, part of the longest side, may be hidden.
        section_sigma: Standard deviation of the log ratio of the scales along x and y.
        aspect_sigma: Standard deviation of the log ratio of the scale along z and the mean of x and y.
        yaw_sigma: Standard deviation of the direction of a handle that the yaw network is sure of, in rad.
    """

    depth_sigma: float = 0.005
    huber: float = 3.0
    rendered_variance: bool = True
    data_weight: float = 0.05
    code_prior: float = 0.3
    tilt_sigma: float = 0.02
    lying_sigma: float = 0.08
    support_sigma: float = 0.0015
    size_sigma: float = 0.08
    mug_size_sigma: float = 1.0
    section_sigma: float = 0.03
    aspect_sigma: float = 0.15
    yaw_sigma: float = 0.25


@dataclass(frozen=True)
class StepLimits:
    """Largest change of each kind of parameter in one iteration; longer steps are shortened as a whole.

    Attributes:
        code: Of each component of the code.
        rotation: About each axis, in radians.
        translation: Along each axis, in metres.
        log_scale: Of the logarithm of each scale.
    """

    code: float = 0.7
    rotation: float = 0.2
    translation: float = 0.02
    log_scale: float = 0.12

    @property
    def vector(self) -> Float[np.ndarray, "25"]:
        """Limits in the order of the parameters."""
        return np.repeat([self.code, self.rotation, self.translation, self.log_scale], [CODE_SIZE, 3, 3, 3])


@dataclass(frozen=True)
class FitState:
    """Pose and shape code of one object."""

    pose: ObjectPose
    code: Float[np.ndarray, "16"]

    def moved(self, step: Float[np.ndarray, "25"]) -> FitState:
        """Return the state after a step in the 25 parameters."""
        return FitState(self.pose.moved(step[CODE_SIZE:]), self.code + step[:CODE_SIZE])

    def step_from(self, other: FitState) -> Float[np.ndarray, "25"]:
        """Return the step that moves another state to this one."""
        turn = so3_log(other.pose.rotation.T @ self.pose.rotation)
        move = self.pose.translation - other.pose.translation
        return np.concatenate(
            [self.code - other.code, turn, move, np.log(self.pose.scale / other.pose.scale)]
        )


@dataclass(frozen=True)
class SizePrior:
    """Prior on the scale from the size of the observed cloud: the longest canonical side is known.

    Attributes:
        scale: (3,) expected scale, in metres per canonical unit.
        sigma: Standard deviation of the log scale.
    """

    scale: Float[np.ndarray, "3"]
    sigma: float


@dataclass(frozen=True)
class SupportCamera:
    """The paper's virtual camera under the object, which looks up through the plane at its bottom.

    Attributes:
        rays: Pixels of the camera.
        T_world_camera: Pose of the camera.
        distance: Distance of the camera from the plane, in metres.
        plane: Support plane.
    """

    rays: RayBundle
    T_world_camera: Float[np.ndarray, "4 4"]
    distance: float
    plane: SupportPlane

    @staticmethod
    def under(
        pose: ObjectPose, plane: SupportPlane, half_width: float, height: float, pixels: int = 14
    ) -> SupportCamera:
        """Return a camera below a pose.

        Args:
            pose: Pose of the object.
            plane: Support plane.
            half_width: Half the side of the visible square of the plane, in metres.
            height: Depth of the sampled range, a quarter of it below the plane, in metres.
            pixels: Pixels along each side of the image.
        """
        distance = 4 * half_width
        foot = pose.translation - (plane.normal @ pose.translation - plane.offset) * plane.normal
        x = np.cross([0.0, 1.0, 0.0], plane.normal)
        x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
        rotation = np.stack([x, np.cross(plane.normal, x), plane.normal], axis=1)
        line = np.linspace(-half_width, half_width, pixels) / distance
        u, v = np.meshgrid(line, line)
        directions = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=-1).astype(np.float32)
        depth_range = np.array([[distance - 0.25 * height, distance + 0.75 * height]])
        rays = RayBundle(directions, np.zeros(u.size, np.int64), depth_range, samples=64)
        return SupportCamera(rays, rigid(rotation, foot - distance * plane.normal), distance, plane)


# Residuals, Jacobian and weights of one kind of residual.
_Rows = tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 25"], Float[np.ndarray, "k"]]


class FitProblem:
    """Residuals, Jacobian and weights of one object as a function of its state, for ``minimise``."""

    def __init__(
        self,
        pixels: PixelSet,
        shape: LinearisedShape,
        support: SupportCamera,
        noise: NoiseConfig,
        size: SizePrior | None = None,
        yaw: YawPrior | None = None,
        renderer: RendererName = "probabilistic",
        resting: RestingPose = "upright",
    ) -> None:
        self._render = RENDERERS[renderer]
        self._target = pixels.target
        if renderer == "silhouette":
            self._target = np.where(pixels.inside, 0.0, BACKDROP).astype(np.float32)
        self.pixels, self.shape, self.support, self.noise, self.size = pixels, shape, support, noise, size
        self.yaw, self.resting = yaw, resting

    def __call__(self, state: FitState) -> Evaluation:
        grid = self.shape.at(state.code)
        blocks = [
            self._code_rows(state),
            self._scale_rows(state),
            self._tilt_rows(state),
            self._support_row(state, grid),
        ]
        if self.yaw is not None:
            blocks.append(self._yaw_row(state, self.yaw))
        residuals, jacobians, weights = (np.concatenate(part) for part in zip(*blocks))
        rendered = len(self.pixels.is_object)
        jacobian = np.empty((rendered + len(residuals), PARAMETERS), np.float32)
        residual, weight = self._render_rows(state, grid, out=jacobian[:rendered])
        jacobian[rendered:] = jacobians
        return Evaluation(np.concatenate([residual, residuals]), jacobian, np.concatenate([weight, weights]))

    def _render_rows(
        self, state: FitState, grid: ShapeGrid, out: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return rendered minus measured depth, and weights: inverse variance, Huber and pixel weight.

        The Jacobian is written to ``out``, which avoids copying a large array.
        """
        pixels, noise = self.pixels, self.noise
        A = canonical_from_camera(state.pose, pixels.Ts_world_camera)
        image = self._render(grid, pixels.rays, A, True)
        residual, variance, weight = image.depth - self._target, image.variance, pixels.weight
        if pixels.operator is None:
            _jacobian(state.pose, A, pixels.rays, image, out)
        else:
            rows = np.empty((len(pixels.rays.directions), PARAMETERS), np.float32)
            out[:] = pixels.operator @ _jacobian(state.pose, A, pixels.rays, image, rows)
            residual, variance, weight = (pixels.operator @ np.column_stack([residual, variance, weight])).T
        sigma2 = variance * noise.rendered_variance + noise.depth_sigma**2
        robust = np.minimum(1.0, noise.huber * np.sqrt(sigma2) / np.maximum(np.abs(residual), 1e-9))
        return residual, noise.data_weight * weight * robust / sigma2

    def _code_rows(self, state: FitState) -> _Rows:
        """Return the standard normal prior of the code."""
        jacobian = np.zeros((CODE_SIZE, PARAMETERS), np.float32)
        jacobian[:, _CODE] = np.eye(CODE_SIZE)
        return state.code, jacobian, np.full(CODE_SIZE, self.noise.code_prior)

    def _scale_rows(self, state: FitState) -> _Rows:
        """Return the priors of the scale ratios, which the code should explain, and of the size if known."""
        ratios = np.array([[1.0, -1.0, 0.0], [-0.5, -0.5, 1.0]])
        jacobian = np.zeros((2, PARAMETERS), np.float32)
        jacobian[:, _SCALE] = ratios
        sigmas = np.array([self.noise.section_sigma, self.noise.aspect_sigma])
        residual, weight = ratios @ np.log(state.pose.scale), sigmas**-2
        if self.size is None:
            return residual, jacobian, weight
        size = np.zeros((3, PARAMETERS), np.float32)
        size[:, _SCALE] = np.eye(3)
        return (
            np.concatenate([residual, np.log(state.pose.scale / self.size.scale)]),
            np.concatenate([jacobian, size]),
            np.concatenate([weight, np.full(3, self.size.sigma**-2)]),
        )

    def _tilt_rows(self, state: FitState) -> _Rows:
        """Return x and y of the plane's normal in the object frame: R^T n changes by hat(R^T n) omega.

        For lying objects z instead, because their axis is parallel to the plane.
        """
        normal = state.pose.rotation.T @ self.support.plane.normal
        lying = self.resting == "lying"
        rows = slice(2, 3) if lying else slice(0, 2)
        sigma = self.noise.lying_sigma if lying else self.noise.tilt_sigma
        jacobian = np.zeros((len(normal[rows]), PARAMETERS), np.float32)
        jacobian[:, _TURN] = hat(normal)[rows]
        return normal[rows], jacobian, np.full(len(jacobian), sigma**-2)

    def _yaw_row(self, state: FitState, prior: YawPrior) -> _Rows:
        """Return the angle about the plane's normal from the nearest mode to the x axis of the object.

        With m the normal in the object frame and e the x axis, it changes by (m - m_x e) / (1 - m_x^2) omega.
        """
        normal, x = self.support.plane.normal, state.pose.rotation[:, 0]
        angles = np.arctan2(np.cross(prior.directions, x) @ normal, prior.directions @ x)
        nearest = int(np.abs(angles).argmin())
        m = state.pose.rotation.T @ normal
        jacobian = np.zeros((1, PARAMETERS), np.float32)
        jacobian[0, _TURN] = (m - [m[0], 0.0, 0.0]) / max(1 - m[0] ** 2, 1e-6)
        angle, sigma = angles[nearest], self.noise.yaw_sigma
        robust = min(1.0, self.noise.huber * sigma / max(abs(angle), 1e-9))
        return np.full(1, angle), jacobian, np.full(1, prior.certainties[nearest] * robust / sigma**2)

    def _support_row(self, state: FitState, grid: ShapeGrid) -> _Rows:
        """Return the mean height over the plane of the lowest parts that the camera underneath sees."""
        camera = self.support
        A = canonical_from_camera(state.pose, camera.T_world_camera[None])
        image = render(grid, camera.rays, A)
        height = image.depth - camera.distance
        hit = image.mask > 0.5
        jacobian = np.zeros((1, PARAMETERS), np.float32)
        if hit.sum() < 4:
            return np.zeros(1), jacobian, np.zeros(1)
        voxel = state.pose.scale[2] / 16
        low = np.partition(height[hit], hit.sum() // 10)[hit.sum() // 10]
        lowest = hit & (height < low + 0.3 * voxel)
        assert image.d_code is not None and image.d_map is not None
        jacobian[0, _CODE] = image.d_code[lowest].mean(axis=0)
        jacobian[0, CODE_SIZE:] = image.d_map[lowest].mean(axis=0) @ map_jacobian(state.pose, A)[0]
        return height[lowest].mean(keepdims=True), jacobian, np.full(1, self.noise.support_sigma**-2)


def _jacobian(
    pose: ObjectPose,
    A: Float[np.ndarray, "v 3 4"],
    rays: RayBundle,
    image: Rendering,
    out: Float[np.ndarray, "n 25"],
) -> Float[np.ndarray, "n 25"]:
    """Write the derivative of the rendered depth with respect to all parameters to ``out`` and return it."""
    assert image.d_code is not None
    out[:, _CODE] = image.d_code
    pose_jacobian(pose, A, rays, image, out=out[:, CODE_SIZE:])
    return out
