"""The least-squares problem of a fit: render residuals, code prior, and what standing on a plane means.

Parameters, 25 in this order: code (16), rotation (3, object frame), translation (3, world), log scale (3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.geometry import hat, rigid, so3_log
from perception.inference.levenberg_marquardt import Evaluation
from perception.inference.observation import PixelSet
from perception.inference.shape_model import LinearisedShape
from perception.rendering.comparison import BACKDROP, RENDERERS, RendererName
from perception.rendering.pose import (
    POSE_SIZE,
    ObjectPose,
    canonical_from_camera,
    map_jacobian,
    pose_jacobian,
)
from perception.rendering.renderer import RayBundle, Rendering, render
from perception.types import CODE_SIZE, SupportPlane

PARAMETERS = CODE_SIZE + POSE_SIZE
_CODE, _TURN, _SCALE = slice(0, 16), slice(16, 19), slice(22, 25)


@dataclass(frozen=True)
class NoiseConfig:
    """How much each residual counts.

    Attributes:
        depth_sigma: floor of the depth's uncertainty [m], beside the rendered variance.
        huber: residuals larger than this many sigma count linearly.
        rendered_variance: whether a pixel's rendered variance counts, beside ``depth_sigma``.
        data_weight: of all render residuals together, against the priors.
        code_prior: weight of the squared code.
        tilt_sigma: of the object's axis against the plane's normal [rad].
        support_sigma: of the object's lowest part against the plane [m].
        size_sigma: of the log scale against the cloud's size: the longest side is known in canonical units.
        mug_size_sigma: the same for mugs, whose handle, part of the longest side, may be hidden.
        section_sigma, aspect_sigma: of the log ratio of the scales along x and y, and along z and both.
    """

    depth_sigma: float = 0.005
    huber: float = 3.0
    rendered_variance: bool = True
    data_weight: float = 0.05
    code_prior: float = 0.3
    tilt_sigma: float = 0.02
    support_sigma: float = 0.0015
    size_sigma: float = 0.08
    mug_size_sigma: float = 1.0
    section_sigma: float = 0.03
    aspect_sigma: float = 0.15


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
    """Pose and shape of one object."""

    pose: ObjectPose
    code: Float[np.ndarray, "16"]

    def moved(self, step: Float[np.ndarray, "25"]) -> FitState:
        return FitState(self.pose.moved(step[CODE_SIZE:]), self.code + step[:CODE_SIZE])

    def step_from(self, other: FitState) -> Float[np.ndarray, "25"]:
        """The step that leads here from another state."""
        turn = so3_log(other.pose.rotation.T @ self.pose.rotation)
        move = self.pose.translation - other.pose.translation
        return np.concatenate(
            [self.code - other.code, turn, move, np.log(self.pose.scale / other.pose.scale)]
        )


@dataclass(frozen=True)
class SupportCamera:
    """The paper's virtual camera under the object: it looks up through the plane at the object's bottom."""

    rays: RayBundle
    T_world_camera: Float[np.ndarray, "4 4"]
    distance: float

    @staticmethod
    def under(
        pose: ObjectPose, plane: SupportPlane, half_width: float, height: float, pixels: int = 14
    ) -> SupportCamera:
        """A camera below the pose that sees ``half_width`` [m] to each side and ``height`` [m] deep."""
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
        return SupportCamera(rays, rigid(rotation, foot - distance * plane.normal), distance)


class FitProblem:
    """Residuals, Jacobian and weights of one object at a state; callable for ``minimise``."""

    def __init__(
        self,
        pixels: PixelSet,
        shape: LinearisedShape,
        plane: SupportPlane | None,
        support: SupportCamera | None,
        noise: NoiseConfig,
        scale: Float[np.ndarray, "3"] | None = None,
        size_sigma: float = 1.0,
        renderer: RendererName = "probabilistic",
    ) -> None:
        """``scale``, if given, is what the cloud's size says about the object's, true to ``size_sigma``."""
        self._render = RENDERERS[renderer]
        self._target = pixels.target
        if renderer == "silhouette":
            self._target = np.where(pixels.inside, 0.0, BACKDROP).astype(np.float32)
        self.pixels, self.shape, self.plane, self.support, self.noise = pixels, shape, plane, support, noise
        self.scale, self.size_sigma = scale, size_sigma

    def __call__(self, state: FitState) -> Evaluation:
        grid = self.shape.at(state.code)
        blocks = [self._code_rows(state), self._scale_rows(state)]
        if self.plane is not None:
            blocks.append(self._tilt_rows(state, self.plane))
        if self.support is not None:
            blocks.append(self._support_row(state, grid, self.support))
        residuals, jacobians, weights = (np.concatenate(part) for part in zip(*blocks))
        rendered = len(self.pixels.is_object)
        jacobian = np.empty((rendered + len(residuals), PARAMETERS), np.float32)
        residual, weight = self._render_rows(state, grid, out=jacobian[:rendered])
        jacobian[rendered:] = jacobians
        return Evaluation(np.concatenate([residual, residuals]), jacobian, np.concatenate([weight, weights]))

    def _render_rows(self, state: FitState, grid, out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rendered minus measured depth, weighted by its variance, Huber's weight and the pixel's own.

        The Jacobian is written to ``out``: it is large, and copying it would cost as much as making it.
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

    def _code_rows(self, state: FitState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        jacobian = np.zeros((CODE_SIZE, PARAMETERS), np.float32)
        jacobian[:, _CODE] = np.eye(CODE_SIZE)
        return state.code, jacobian, np.full(CODE_SIZE, self.noise.code_prior)

    def _scale_rows(self, state: FitState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Scales along the axes differ little: the code shapes, the scale sizes."""
        ratios = np.array([[1.0, -1.0, 0.0], [-0.5, -0.5, 1.0]])
        jacobian = np.zeros((2, PARAMETERS), np.float32)
        jacobian[:, _SCALE] = ratios
        sigmas = np.array([self.noise.section_sigma, self.noise.aspect_sigma])
        residual, weight = ratios @ np.log(state.pose.scale), sigmas**-2
        if self.scale is None:
            return residual, jacobian, weight
        size = np.zeros((3, PARAMETERS), np.float32)
        size[:, _SCALE] = np.eye(3)
        return (
            np.concatenate([residual, np.log(state.pose.scale / self.scale)]),
            np.concatenate([jacobian, size]),
            np.concatenate([weight, np.full(3, self.size_sigma**-2)]),
        )

    def _tilt_rows(self, state: FitState, plane: SupportPlane) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The plane's normal in the object frame has no x and y: R^T n changes by hat(R^T n) omega."""
        normal = state.pose.rotation.T @ plane.normal
        jacobian = np.zeros((2, PARAMETERS), np.float32)
        jacobian[:, _TURN] = hat(normal)[:2]
        return normal[:2], jacobian, np.full(2, self.noise.tilt_sigma**-2)

    def _support_row(
        self, state: FitState, grid, camera: SupportCamera
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The lowest parts that the lower camera sees lie on the plane: one residual, their mean height."""
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
    """Writes the derivative of the rendered depth by all parameters, and returns it."""
    assert image.d_code is not None
    out[:, _CODE] = image.d_code
    pose_jacobian(pose, A, rays, image, out=out[:, CODE_SIZE:])
    return out
