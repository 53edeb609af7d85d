"""Camera tracking: the pose of one frame by Levenberg-Marquardt against the map, which is fixed.

NodeSLAM, section "Camera Tracking": all associated objects are rendered, the nearest in front, and the
weighted difference between rendered and measured depth determines the pose. The support plane can be one more
landmark.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from perception.geometry import invert, se3_exp, se3_log
from perception.inference.levenberg_marquardt import Evaluation, LmConfig, minimise
from perception.rendering.multi_object import PairRenderer, RayPairs, nearest_pair
from perception.rendering.pose import canonical_from_camera, object_by_camera
from perception.slam.bounding_spheres import BoundingSpheres
from perception.slam.landmarks import LandmarkMap
from perception.slam.pixels import TrackingPixels
from perception.slam.plane_factor import PlaneNoise, evaluate_plane

_SPHERE_MARGIN = 0.01  # [m] added to bounding spheres, as occlusions are determined at the predicted pose


@dataclass(frozen=True)
class TrackingConfig:
    """Budget and weights of the pose optimisation.

    Attributes:
        depth_sigma: Standard deviation of the measured depth, in metres; adds to the rendered variance.
        huber: Residuals beyond this many sigma are weighted linearly (Huber).
        data_weight: Factor on the weights of all pixels, for the correlation between neighbouring ones.
        background_weight: Weight of a ring pixel relative to one of the object.
        truncated_weight: Factor on the weights of truncated landmarks, whose invisible part can be far off,
            where at least ``min_complete`` others are used.
        min_complete: Number of used landmarks that are not truncated from which truncated ones count less.
        use_uncertainty: Whether the rendered variance enters the weights.
        use_plane: Whether the support plane constrains the camera.
        plane_sigma: Standard deviation of a plane point's height, in metres.
        iterations: Largest number of Levenberg-Marquardt iterations.
        rotation_sigma, translation_sigma: Standard deviation of the predicted pose if no prior is given, in
            radians and metres.
        inlier_distance: Residual below which a pixel agrees with the map, in metres.
        inlier_ratio_min: Landmarks whose inlier ratio is below this share of the best one are not used.
        min_pixels: Least number of pixels for which an inlier ratio is computed.
        lm: Damping, and the step (radians, metres) below which the optimisation has converged.
        threads: Number of rendering threads.
    """

    depth_sigma: float = 0.003
    huber: float = 3.0
    data_weight: float = 0.05
    background_weight: float = 0.2
    truncated_weight: float = 0.3
    min_complete: int = 3
    use_uncertainty: bool = True
    use_plane: bool = True
    plane_sigma: float = 0.005
    iterations: int = 3
    rotation_sigma: float = np.radians(0.8)
    translation_sigma: float = 0.008
    inlier_distance: float = 0.012
    inlier_ratio_min: float = 0.5
    min_pixels: int = 25
    lm: LmConfig = field(default_factory=lambda: LmConfig(damping=1e-3, least_step=2e-4))
    threads: int = 2


@dataclass(frozen=True)
class TrackedPose:
    """Result of tracking.

    Attributes:
        T_world_camera: Optimised camera pose.
        inlier_ratios: Share of pixels that agree with the map, of each landmark with enough pixels.
        used: Ids of the landmarks that the pose was optimised with.
        information: Information of the frame on the pose (rotation, translation, camera frame), without the
            prior, with the uncertainty of the landmarks marginalised out.
    """

    T_world_camera: Float[np.ndarray, "4 4"]
    inlier_ratios: Mapping[int, float]
    used: frozenset[int]
    information: Float[np.ndarray, "6 6"]

    @property
    def median_inlier_ratio(self) -> float:
        """Median inlier ratio of all judged landmarks; 0 if there are none."""
        return float(np.median(list(self.inlier_ratios.values()))) if self.inlier_ratios else 0.0

    @property
    def median_inlier_ratio_of_used(self) -> float:
        """The same of the used landmarks: objects that were moved do not make the pose implausible."""
        ratios = [ratio for id, ratio in self.inlier_ratios.items() if id in self.used]
        return float(np.median(ratios)) if ratios else 0.0


def track(
    world: LandmarkMap,
    pixels: TrackingPixels,
    T_predicted: Float[np.ndarray, "4 4"],
    config: TrackingConfig = TrackingConfig(),
    excluded: frozenset[int] = frozenset(),
    prior: Float[np.ndarray, "6 6"] | None = None,
) -> TrackedPose:
    """Optimise the camera pose, starting from the predicted one.

    Landmarks that disagree with most others are dropped, and the pose is optimised once more.

    Args:
        world: The map.
        pixels: Selected pixels of the frame.
        T_predicted: Predicted camera pose.
        config: Budget and weights.
        excluded: Landmarks that are judged but not used, unless there are no others.
        prior: Information on the predicted pose (rotation, translation, camera frame); by default from the
            config's standard deviations.
    """
    problem = _PoseProblem(world, pixels, T_predicted, config, prior)
    used = frozenset(problem.visible - excluded) or frozenset(problem.visible)
    pose, evaluation, ratios = problem.solve(T_predicted, used, config.iterations)
    best = max((ratios[id] for id in used if id in ratios), default=0.0)
    outliers = {id for id in used if ratios.get(id, best) < config.inlier_ratio_min * best}
    if outliers and len(used) > len(outliers):
        used = used - outliers
        pose, evaluation, ratios = problem.solve(pose, used, config.iterations)
    return TrackedPose(pose, ratios, used, problem.information(pose, evaluation))


class _PoseProblem:
    """Residuals of one frame as a function of the camera pose.

    Depth ranges and the pairs of rays and objects are fixed at the predicted pose.

    Attributes:
        visible: Ids of the landmarks with pixels.
        landmark_ids: Landmark of each pixel.
        pairs: Pairs of rays and objects that are rendered; ``own`` marks those of a pixel and its landmark.
        target: Measured depth of object pixels, escape depth of ring pixels, in metres.
    """

    def __init__(
        self,
        world: LandmarkMap,
        pixels: TrackingPixels,
        T_predicted: Float[np.ndarray, "4 4"],
        config: TrackingConfig,
        prior: Float[np.ndarray, "6 6"] | None,
    ) -> None:
        self.world, self.config, self.T_predicted = world, config, T_predicted
        self.plane_points = pixels.plane_points
        pixels = pixels.subset(np.isin(pixels.landmark_ids, world.ids))
        self.landmark_ids, self.directions = pixels.landmark_ids, pixels.directions
        self.is_object = pixels.is_object
        index_of = {id: k for k, id in enumerate(world.ids)}
        self.index = np.array([index_of[id] for id in self.landmark_ids], dtype=np.int64)
        self.visible = {int(id) for id in np.unique(self.landmark_ids)}
        self.poses = [world.landmarks[id].state.pose for id in world.ids]
        self.truncated = [(id, world.landmarks[id].truncated) for id in world.ids]
        self.pairs, self.own = self._pair_up()
        self.render = None
        escape_depth = np.zeros(0)
        if len(self.landmark_ids):
            self.render = PairRenderer(world.stack, self.pairs, threads=config.threads)
            escape_depth = self.pairs.escape_depth[self.index]
        self.target = np.where(self.is_object, pixels.depth, escape_depth)
        self.plane_noise = PlaneNoise(config.plane_sigma, config.huber, config.data_weight)
        if prior is None:
            sigmas = [config.rotation_sigma**-2, config.translation_sigma**-2]
            prior = np.diag(np.repeat(sigmas, 3))
        self.prior_root = np.linalg.cholesky(prior).T

    def _pair_up(self) -> tuple[RayPairs, Bool[np.ndarray, "p"]]:
        """Pair each ray with its own object and with the nearer ones whose bounding sphere it intersects."""
        landmarks = [self.world.landmarks[id] for id in self.world.ids]
        spheres = BoundingSpheres.of(self.world, self.T_predicted, _SPHERE_MARGIN)
        step = np.array([landmark.sample_distance for landmark in landmarks])
        n, z = len(self.landmark_ids), spheres.centres[:, 2]
        own = np.zeros((n, len(landmarks)), bool)
        own[np.arange(n), self.index] = True
        nearer = z[None] < z[self.index][:, None] if n else np.zeros((0, len(z)), bool)
        ray, index = np.nonzero(own | (nearer & spheres.hit_by(self.directions)))
        return RayPairs(self.directions, ray, index, spheres.depth_range, step), own[ray, index]

    def solve(
        self, start: Float[np.ndarray, "4 4"], used: frozenset[int], iterations: int
    ) -> tuple[Float[np.ndarray, "4 4"], Evaluation, dict[int, float]]:
        """Return the optimised pose, the residuals there and the inlier ratios."""
        result = minimise(
            lambda T: self.evaluate(T, used),
            lambda T, step: _orthonormalised(T @ se3_exp(step)),
            start,
            replace(self.config.lm, max_iterations=iterations),
        )
        return result.state, result.evaluation, self.inlier_ratios(result.evaluation)

    def evaluate(self, T_world_camera: Float[np.ndarray, "4 4"], used: frozenset[int]) -> Evaluation:
        """Return all residuals: of the objects, of the prior, of the plane."""
        blocks = [self._object_rows(T_world_camera, used), self._prior_rows(T_world_camera)]
        if self._has_plane:
            blocks.append(self._plane_rows(T_world_camera))
        return Evaluation(
            np.concatenate([block.residuals for block in blocks]),
            np.concatenate([block.jacobian for block in blocks]),
            np.concatenate([block.weights for block in blocks]),
        )

    @property
    def _has_plane(self) -> bool:
        return self.config.use_plane and len(self.plane_points) > 0

    def _object_rows(self, T: Float[np.ndarray, "4 4"], used: frozenset[int]) -> Evaluation:
        """Rendered minus measured depth, weighted by rendered variance, Huber's weight and the landmark's."""
        config = self.config
        if self.render is None:
            return Evaluation(np.zeros(0), np.zeros((0, 6)), np.zeros(0))
        image = self.render(np.concatenate([canonical_from_camera(pose, T[None]) for pose in self.poses]))
        shown = nearest_pair(self.pairs, self.own, image.depth, image.mask)
        residual = image.depth[shown] - self.target
        variance = image.variance[shown] if config.use_uncertainty else 0.0
        sigma = np.sqrt(variance + config.depth_sigma**2)
        robust = np.minimum(1.0, config.huber * sigma / np.maximum(np.abs(residual), 1e-9))
        weight = np.where(self.is_object, 1.0, config.background_weight) * robust / sigma**2
        weight = weight * self._landmark_weights(used)[self.index] * config.data_weight
        jacobian = image.jacobian[shown].astype(np.float64)
        return Evaluation(residual.astype(np.float64), jacobian, weight)

    def _landmark_weights(self, used: frozenset[int]) -> Float[np.ndarray, "o"]:
        """Return the weight of each landmark's pixels, 0 for those that are not used."""
        n_complete = sum(
            id in used and id in self.visible and not truncated for id, truncated in self.truncated
        )
        weight = self.config.truncated_weight if n_complete >= self.config.min_complete else 1.0
        return np.array(
            [(weight if truncated else 1.0) if id in used else 0.0 for id, truncated in self.truncated]
        )

    def _plane_rows(self, T: Float[np.ndarray, "4 4"]) -> Evaluation:
        return evaluate_plane(T, self.plane_points, self.world.plane, self.plane_noise)

    def _prior_rows(self, T: Float[np.ndarray, "4 4"]) -> Evaluation:
        """Distance from the predicted pose; its derivative is the identity to first order."""
        residual = self.prior_root @ se3_log(invert(self.T_predicted) @ T)
        return Evaluation(residual, self.prior_root, np.ones(6))

    def information(self, T: Float[np.ndarray, "4 4"], evaluation: Evaluation) -> Float[np.ndarray, "6 6"]:
        """Return the information of the frame on the pose, with the landmarks' uncertainty marginalised out.

        The error of a landmark's pose is common to all its pixels, so they hold no more information on the
        camera than there is on the landmark: with H of its pixels and P of its pose, H - H (H + P)^-1 H.
        """
        total = np.zeros((6, 6))
        if len(self.landmark_ids):
            order = np.argsort(self.landmark_ids, kind="stable")
            ids, starts = np.unique(self.landmark_ids[order], return_index=True)
            J, weights = evaluation.jacobian[order].astype(np.float64), evaluation.weights[order, None]
            H = np.add.reduceat((weights * J)[:, :, None] * J[:, None, :], starts)
            landmarks = [self.world.landmarks[int(id)] for id in ids]
            by_camera = np.stack([object_by_camera(x.state.pose, T) for x in landmarks])
            covariances = np.stack([x.covariance for x in landmarks])
            P = by_camera.transpose(0, 2, 1) @ np.linalg.solve(covariances, by_camera)
            total = (H - H @ np.linalg.solve(H + P, H)).sum(axis=0)
        if self._has_plane:
            rows = self._plane_rows(T)
            total += rows.jacobian.T @ (rows.weights[:, None] * rows.jacobian)
        return (total + total.T) / 2

    def inlier_ratios(self, evaluation: Evaluation) -> dict[int, float]:
        """Return the share of agreeing pixels of every landmark with enough object pixels."""
        ratios = {}
        residual = evaluation.residuals[: len(self.landmark_ids)]
        for id in self.visible:
            own = self.is_object & (self.landmark_ids == id)
            if own.sum() >= self.config.min_pixels:
                ratios[id] = float((np.abs(residual[own]) < self.config.inlier_distance).mean())
        return ratios


def _orthonormalised(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    u, _, vt = np.linalg.svd(T[:3, :3])
    out = np.array(T)
    out[:3, :3] = u @ vt
    return out
