"""Fit of an object's pose to the measured depth around where it is expected, and what speaks for a pose.

The object is rendered at a pose, and Levenberg-Marquardt corrects the pose by the measured depth near the
rendering. Pixels whose depth agrees speak for a pose, those measured behind it against it; occluded ones do
not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
from jaxtyping import Bool, Float

from perception.geometry import hat, invert, transform_points
from perception.inference.levenberg_marquardt import Evaluation, LmConfig, minimise
from perception.inference.observation import pixel_rays
from perception.inference.voxelise import voxels_of
from perception.rendering.pose import ObjectPose, canonical_from_camera, pose_jacobian
from perception.rendering.renderer import RayBundle, ShapeGrid, render
from perception.types import GRID_RESOLUTION, ObjectEstimate, RgbdFrame, SupportPlane, TriangleMesh


@dataclass(frozen=True)
class RefitConfig:
    """Settings of a pose check.

    Attributes:
        crop: Pixels along the longer side of each view's crop.
        step: Length of a render step along a ray, in voxels.
        margin: Width of the searched region around the object, in metres.
        reaches: Largest depth residual of an inlier in each pass, in metres.
        iterations: Number of iterations of each pass.
        depth_sigma: Standard deviation of a depth measurement, in metres.
        tilt_sigma: Standard deviation of the prior on the tilt, in radians.
        agree: Largest depth residual of a pixel that agrees with the object, in metres.
        min_pixels: Smallest number of visible pixels of the full images for a decision.
        min_share: Smallest share of the visible pixels that must agree.
        min_own: Smallest share of them that agree and that nothing below the object explains: a bowl that is
            not in another one is found in the surface of that one otherwise.
        starts: Offset of the other initial positions, tried if the expected one fails, in metres.
    """

    crop: int = 64
    step: float = 0.45
    margin: float = 0.03
    reaches: tuple[float, ...] = (0.03, 0.015)
    iterations: int = 10
    depth_sigma: float = 0.003
    tilt_sigma: float = 0.3
    agree: float = 0.008
    min_pixels: int = 80
    min_share: float = 0.6
    min_own: float = 0.4
    starts: float = 0.02


class PoseSearch:
    """Measured pixels around the expected position and the fit of a pose to them.

    Attributes:
        config: Settings.
        plane: Support plane.
        scale: (3,) metres per canonical unit, with which the mesh fits into the cube.
        shape: Occupancy grid of the mesh.
        radius: Radius of a sphere about the object's origin that contains the mesh, in metres.
        rays: Rays of the measured pixels.
        measured: Measured depth of each ray, in metres.
        area: Number of pixels of the full image that each ray represents.
        cameras: (n, 4, 4) poses T_world_camera of the views with measurements.
        explained: Smallest depth residual of each ray with respect to another object, in metres; infinite
            where none is rendered.
        explained_below: The same of those objects alone whose lowest point is below that of this one.
    """

    def __init__(
        self,
        estimate: ObjectEstimate,
        frames: Sequence[RgbdFrame],
        T_expected: Float[np.ndarray, "4 4"],
        others: Sequence[ObjectEstimate],
        plane: SupportPlane,
        config: RefitConfig,
    ) -> None:
        self.config, self.plane = config, plane
        grid, self.scale = voxels_of(estimate.mesh)
        self.shape = ShapeGrid.upload(grid, skip_occupancy=1e-3)
        voxel = 2 * float(self.scale.mean()) / GRID_RESOLUTION
        self.radius = float(np.linalg.norm(np.abs(estimate.mesh.vertices).max(axis=0)))
        self.samples = int(np.clip(2 * (self.radius + config.margin) / (config.step * voxel), 24, 256))
        centre = np.asarray(T_expected)[:3, 3]
        self.rays, self.measured, self.area, self.cameras = self._gather(frames, centre)
        base = _lowest(estimate.mesh, T_expected)
        below = [_lowest(other.mesh, other.T_world_object) < base for other in others]
        each = [self._residuals(other) for other in others]
        none = np.full(len(self.measured), np.inf, np.float32)
        self.explained = np.min([none, *each], axis=0)
        self.explained_below = np.min([none, *compress(each, below)], axis=0)

    def _gather(
        self, frames: Sequence[RgbdFrame], centre: Float[np.ndarray, "3"]
    ) -> tuple[RayBundle, Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "v 4 4"]]:
        """Return rays, measured depths, pixel areas and camera poses of the views around a point."""
        config, reach = self.config, self.radius + self.config.margin
        directions, view, measured, area, depth_range, cameras = [], [], [], [], [], []
        for frame in frames:
            assert frame.T_world_camera is not None
            p = transform_points(invert(frame.T_world_camera), centre[None])[0]
            if p[2] <= 0.05:
                continue
            camera = frame.intrinsics
            half = reach * camera.fx / p[2]
            middle = np.array([camera.fx * p[0], camera.fy * p[1]]) / p[2] + (camera.cx, camera.cy)
            low = np.clip(middle - half, 0, (camera.width - 1, camera.height - 1))
            high = np.clip(middle + half, 0, (camera.width - 1, camera.height - 1))
            pitch = max(1.0, float((high - low).max()) / config.crop)
            u, v = np.meshgrid(
                np.arange(low[0], high[0], pitch).round().astype(int),
                np.arange(low[1], high[1], pitch).round().astype(int),
            )
            depth = frame.depth[v, u]
            valid = depth > 0
            if not valid.any():
                continue
            directions.append(pixel_rays(frame, u, v)[valid])
            view.append(np.full(int(valid.sum()), len(cameras)))
            measured.append(depth[valid])
            area.append(np.full(int(valid.sum()), pitch**2))
            depth_range.append((max(p[2] - reach, 0.02), p[2] + reach))
            cameras.append(frame.T_world_camera)
        if not cameras:
            none = np.zeros(0, np.float32)
            rays = RayBundle(
                np.zeros((0, 3), np.float32), np.zeros(0, np.int64), np.ones((1, 2)), self.samples
            )
            return rays, none, none, np.eye(4)[None]
        rays = RayBundle(
            np.concatenate(directions).astype(np.float32),
            np.concatenate(view),
            np.array(depth_range),
            self.samples,
        )
        return rays, np.concatenate(measured), np.concatenate(area), np.stack(cameras)

    def _residuals(self, other: ObjectEstimate) -> Float[np.ndarray, "n"]:
        """Return the depth residual [m] of each ray with respect to an object; infinite without a hit."""
        if not len(self.measured):
            return np.zeros(0, np.float32)
        grid, scale = voxels_of(other.mesh)
        pose = ObjectPose.of(other.T_world_object, scale)
        shape = ShapeGrid.upload(grid, skip_occupancy=1e-3)
        centres = [transform_points(invert(T), pose.translation[None])[0, 2] for T in self.cameras]
        reach = float(np.linalg.norm(0.9 * scale)) + 0.01
        ranges = np.array([(max(z - reach, 0.01), max(z + reach, 0.02)) for z in centres])
        rays = RayBundle(self.rays.directions, self.rays.view, ranges, self.rays.samples)
        image = render(shape, rays, canonical_from_camera(pose, self.cameras), gradients=False)
        return np.where(image.mask > 0.5, np.abs(image.depth - self.measured), np.inf)

    def refine(self, pose: ObjectPose, reaches: Sequence[float] | None = None) -> ObjectPose:
        """Return the pose of least squares to the measured depth within ``reaches``, from an initial pose."""
        limit = np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])
        if not len(self.measured):
            return pose
        for reach in reaches or self.config.reaches:
            result = minimise(
                lambda p, reach=reach: self._evaluate(p, reach),
                lambda p, step: p.moved(np.concatenate([step, np.zeros(3)])),
                pose,
                LmConfig(max_iterations=self.config.iterations, damping=1e-3),
                limit,
            )
            pose = result.state
        return pose

    def _evaluate(self, pose: ObjectPose, reach: float) -> Evaluation:
        measured = self.linearised(pose, reach)
        normal = pose.rotation.T @ self.plane.normal
        upright = np.zeros((2, 6), np.float32)
        upright[:, :3] = hat(normal)[:2]
        return Evaluation(
            np.concatenate([measured.residuals, normal[:2]]),
            np.concatenate([measured.jacobian, upright]),
            np.concatenate([measured.weights, np.full(2, self.config.tilt_sigma**-2)]),
        )

    def linearised(self, pose: ObjectPose, reach: float) -> Evaluation:
        """Return the depth residuals [m] at a pose and their derivative with respect to (omega, v).

        Pixels without weight are those off the object, beyond ``reach`` [m], or explained by another object.
        """
        A = canonical_from_camera(pose, self.cameras)
        image = render(self.shape, self.rays, A)
        jacobian = pose_jacobian(pose, A, self.rays, image)[:, :6]
        residual = image.depth - self.measured
        own = (image.mask > 0.7) & (np.abs(residual) < reach) & (np.abs(residual) <= self.explained + 0.002)
        sigma2 = image.variance + self.config.depth_sigma**2
        robust = np.minimum(1.0, 2 * np.sqrt(sigma2) / np.maximum(np.abs(residual), 1e-9))
        return Evaluation(residual, jacobian, own * robust / sigma2)

    def evidence(self, pose: ObjectPose, alone: bool = False) -> tuple[float, float]:
        """Return the numbers of full-image pixels that agree with the object and that measure behind it.

        Those that another object explains better do not agree; with ``alone``, none that one explains at all.
        """
        if not len(self.measured):
            return 0.0, 0.0
        image = render(self.shape, self.rays, canonical_from_camera(pose, self.cameras), gradients=False)
        behind = self.measured - image.depth
        on: Bool[np.ndarray, "n"] = image.mask > 0.8
        least = self.config.agree if alone else np.abs(behind) - 0.002
        own = on & (np.abs(behind) < self.config.agree) & (self.explained >= least)
        return float(self.area[own].sum()), float(self.area[on & (behind >= self.config.agree)].sum())

    def own(self, pose: ObjectPose) -> float:
        """Return the number of full-image pixels that agree and that nothing below the object explains."""
        if not len(self.measured):
            return 0.0
        image = render(self.shape, self.rays, canonical_from_camera(pose, self.cameras), gradients=False)
        agree = (image.mask > 0.8) & (np.abs(self.measured - image.depth) < self.config.agree)
        return float(self.area[agree & (self.explained_below >= self.config.agree)].sum())

    def gain(self, pose: ObjectPose, alone: bool = False) -> float:
        """Return by how many pixels those that agree outnumber those that contradict.

        Unlike their share, it tells a pose that explains what is seen from one that hides behind it.
        """
        agree, through = self.evidence(pose, alone)
        return agree - through

    def share(self, pose: ObjectPose) -> float:
        """Return the share of the visible pixels that agree with the object at a pose."""
        agree, through = self.evidence(pose)
        return agree / max(agree + through, 1.0)


def _lowest(mesh: TriangleMesh, T_world_object: Float[np.ndarray, "4 4"]) -> float:
    """Return the height [m] of the lowest vertex of a mesh."""
    return float((mesh.vertices @ T_world_object[2, :3]).min() + T_world_object[2, 3])
