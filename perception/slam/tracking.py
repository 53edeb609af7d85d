"""Where the camera is: Levenberg-Marquardt on one frame's pose against the map, which stands still.

NodeSLAM, section "Camera Tracking": all matched objects are rendered, the least depth wins, and the weighted
difference to the measured depth moves the camera. The support plane can help as one more landmark.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from perception.geometry import invert, se3_exp, se3_log
from perception.inference.levenberg_marquardt import Evaluation, LmConfig, minimise
from perception.rendering.multi_object import PairRenderer, RayPairs, nearest_pair
from perception.rendering.pose import canonical_from_camera, object_by_camera
from perception.slam.landmarks import LandmarkMap
from perception.slam.pixels import TrackingPixels


@dataclass(frozen=True)
class TrackingConfig:
    """How a pose is found.

    Attributes:
        depth_sigma: floor of the depth's uncertainty [m], beside the rendered variance.
        huber: residuals larger than this many sigma count linearly.
        data_weight: of pixels, which err together, against the prior.
        background_weight: of a ring's pixel; one of the object has 1.
        cut_weight: of the pixels of a landmark that the image cut when it began, until it is seen whole: the
            part that was not in view may be far off. Only where ``enough`` others hold the camera.
        use_uncertainty: weights by the rendered variance; otherwise all pixels count alike.
        use_plane: the plane is a landmark.
        plane_sigma: of a point of the plane [m].
        iterations: of Levenberg-Marquardt.
        turn_sigma, move_sigma: of a start about which nothing better is known [rad], [m].
        inlier: residuals smaller than this agree with the map [m].
        outcast: objects with less than this share of the best one's inliers are left out.
        min_pixels: of an object, to judge it.
        lm: damping, and the step [rad, m] under which it is not gone on.
        threads: that render.
    """

    depth_sigma: float = 0.003
    huber: float = 3.0
    data_weight: float = 0.05
    background_weight: float = 0.2
    cut_weight: float = 0.3
    enough: int = 3
    use_uncertainty: bool = True
    use_plane: bool = True
    plane_sigma: float = 0.005
    iterations: int = 3
    turn_sigma: float = np.radians(0.8)
    move_sigma: float = 0.008
    inlier: float = 0.012
    outcast: float = 0.5
    min_pixels: int = 25
    lm: LmConfig = field(default_factory=lambda: LmConfig(damping=1e-3, least_step=2e-4))
    threads: int = 2

    def loosened(self, factor: float) -> TrackingConfig:
        """For a pose that is so much less sure."""
        return replace(self, turn_sigma=factor * self.turn_sigma, move_sigma=factor * self.move_sigma)


@dataclass(frozen=True)
class TrackedPose:
    """Where the camera was found.

    Attributes:
        T_world_camera: its pose.
        shares: of each landmark with enough pixels, those that agree with the map.
        used: landmarks that took part.
        information: (6, 6) of the pose (rotation, translation, in the camera's frame), without the prior, as
            far as the landmarks themselves are known.
    """

    T_world_camera: Float[np.ndarray, "4 4"]
    shares: Mapping[int, float]
    used: frozenset[int]
    information: Float[np.ndarray, "6 6"]

    @property
    def share(self) -> float:
        """Median share of agreeing pixels; 0 where nothing could be judged."""
        return float(np.median(list(self.shares.values()))) if self.shares else 0.0

    @property
    def share_of_used(self) -> float:
        """The same over the landmarks that took part: what a hand has moved says nothing of the camera."""
        shares = [share for one, share in self.shares.items() if one in self.used]
        return float(np.median(shares)) if shares else 0.0


def track(
    world: LandmarkMap,
    pixels: TrackingPixels,
    T_predicted: Float[np.ndarray, "4 4"],
    config: TrackingConfig,
    suspects: frozenset[int] = frozenset(),
    prior: Float[np.ndarray, "6 6"] | None = None,
) -> TrackedPose:
    """Finds the camera near its predicted pose.

    Args:
        world: the map.
        pixels: what the frame shows of it.
        T_predicted: where the camera should be.
        config: weights and budgets.
        suspects: landmarks that have disagreed lately: judged, but not used.
        prior: information on the predicted pose; from the config's sigmas if not given.
    """
    problem = _PoseProblem(world, pixels, T_predicted, config, prior)
    use = frozenset(problem.seen - suspects) or frozenset(problem.seen)
    pose, evaluation, shares = problem.solve(T_predicted, use, config.iterations)
    best = max((shares[i] for i in use if i in shares), default=0.0)
    outcasts = {i for i in use if shares.get(i, best) < config.outcast * best}
    if outcasts and len(use) > len(outcasts):
        use = use - outcasts
        pose, evaluation, shares = problem.solve(pose, use, config.iterations)
    return TrackedPose(pose, shares, use, problem.information(pose, evaluation))


class _PoseProblem:
    """Residuals of one frame at a pose; depth ranges and the pairs of rays and objects stay as predicted."""

    def __init__(
        self,
        world: LandmarkMap,
        pixels: TrackingPixels,
        T_predicted: np.ndarray,
        config: TrackingConfig,
        prior: np.ndarray | None = None,
    ) -> None:
        self.world, self.pixels, self.config, self.T_predicted = world, pixels, config, T_predicted
        known = np.isin(pixels.owner, world.ids)
        order = {one: k for k, one in enumerate(world.ids)}
        self.owner = pixels.owner[known]
        self.own_index = np.array([order[i] for i in self.owner], dtype=np.int64)
        self.directions, self.depth = pixels.directions[known], pixels.depth[known]
        self.is_object = pixels.is_object[known]
        self.cut = [(one, world.landmarks[one].cut) for one in world.ids]
        self.seen = {int(i) for i in np.unique(self.owner)}
        self.poses = [world.landmarks[i].state.pose for i in world.ids]
        self.pairs, self.own = self._pair_up()
        self.render = (
            PairRenderer(world.stack, self.pairs, threads=config.threads) if len(self.owner) else None
        )
        escape = self.pairs.escape_depth[self.own_index] if len(self.owner) else np.zeros(0)
        self.target = np.where(self.is_object, self.depth, escape)
        if prior is None:
            prior = np.diag(np.repeat([config.turn_sigma**-2, config.move_sigma**-2], 3))
        self.prior_root = np.linalg.cholesky(prior).T

    def _pair_up(self) -> tuple[RayPairs, np.ndarray]:
        """Each ray with its own object and with those whose sphere it meets no farther away."""
        landmarks = [self.world.landmarks[i] for i in self.world.ids]
        T_camera_world = invert(self.T_predicted)
        centres = np.array([pose.translation for pose in self.poses]).reshape(-1, 3)
        centres = centres @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        reach = np.array([one.reach for one in landmarks]) + 0.01
        z = centres[:, 2]
        depth_range = np.stack([np.maximum(z - reach, 0.02), np.maximum(z + reach, 0.05)], axis=1)
        step = np.array([one.sample_distance for one in landmarks])
        own = np.zeros((len(self.owner), len(landmarks)), bool)
        own[np.arange(len(self.owner)), self.own_index] = True
        unit = self.directions / np.linalg.norm(self.directions, axis=1, keepdims=True)
        along = unit @ centres.T
        miss2 = (centres**2).sum(axis=1) - along**2
        nearer = z[None] < z[self.own_index][:, None] if len(self.owner) else np.zeros((0, len(z)), bool)
        meets = own | (nearer & (along > 0) & (miss2 < reach**2))
        ray, index = np.nonzero(meets)
        return RayPairs(self.directions, ray, index, depth_range, step), own[ray, index]

    def solve(
        self, start: np.ndarray, use: frozenset[int], iterations: int
    ) -> tuple[np.ndarray, Evaluation, dict[int, float]]:
        result = minimise(
            lambda T: self.evaluate(T, use),
            lambda T, step: _orthonormal(T @ se3_exp(step)),
            start,
            replace(self.config.lm, max_iterations=iterations),
        )
        return result.state, result.evaluation, self.shares(result.evaluation)

    def evaluate(self, T_world_camera: np.ndarray, use: frozenset[int]) -> Evaluation:
        blocks = [self._object_rows(T_world_camera, use), self._prior_rows(T_world_camera)]
        if self.config.use_plane and len(self.pixels.plane_points):
            blocks.append(self._plane_rows(T_world_camera))
        residuals, jacobians, weights = zip(*blocks)
        return Evaluation(np.concatenate(residuals), np.concatenate(jacobians), np.concatenate(weights))

    def _object_rows(self, T: np.ndarray, use: frozenset[int]) -> tuple[np.ndarray, ...]:
        config = self.config
        if self.render is None:
            return np.zeros(0), np.zeros((0, 6)), np.zeros(0)
        image = self.render(np.concatenate([canonical_from_camera(pose, T[None]) for pose in self.poses]))
        shown = nearest_pair(self.pairs, self.own, image.depth, image.mask)
        residual = image.depth[shown] - self.target
        variance = image.variance[shown] if config.use_uncertainty else 0.0
        sigma = np.sqrt(variance + config.depth_sigma**2)
        robust = np.minimum(1.0, config.huber * sigma / np.maximum(np.abs(residual), 1e-9))
        weight = np.where(self.is_object, 1.0, config.background_weight) * robust / sigma**2
        weight = weight * self._trust(use)[self.own_index] * config.data_weight
        return residual.astype(np.float64), image.jacobian[shown].astype(np.float64), weight

    def _trust(self, use: frozenset[int]) -> Float[np.ndarray, "o"]:
        """How much the pixels of each landmark count."""
        whole = sum(one in use and one in self.seen and not cut for one, cut in self.cut)
        part = self.config.cut_weight if whole >= self.config.enough else 1.0
        return np.array([(part if cut else 1.0) if one in use else 0.0 for one, cut in self.cut])

    def _plane_rows(self, T: np.ndarray) -> tuple[np.ndarray, ...]:
        """Heights of the plane's points: n . (R p + t) - offset."""
        config, points, plane = self.config, self.pixels.plane_points, self.world.plane
        normal = T[:3, :3].T @ plane.normal
        residual = points @ normal + T[:3, 3] @ plane.normal - plane.offset
        jacobian = np.concatenate([np.cross(points, normal), np.broadcast_to(normal, points.shape)], axis=1)
        robust = np.minimum(1.0, config.huber * config.plane_sigma / np.maximum(np.abs(residual), 1e-9))
        return residual, jacobian, config.data_weight * robust / config.plane_sigma**2

    def _prior_rows(self, T: np.ndarray) -> tuple[np.ndarray, ...]:
        """The pose is near the predicted one; to first order the step is the difference's change."""
        return self.prior_root @ se3_log(invert(self.T_predicted) @ T), self.prior_root, np.ones(6)

    def information(self, T: np.ndarray, evaluation: Evaluation) -> Float[np.ndarray, "6 6"]:
        """What the frame knows of the pose, each landmark standing where it is only as surely as it is known.

        A landmark's error moves all its pixels alike, so however many there are it tells no more of the pose
        than of itself: with H of its pixels and P the information on it, H - H (H + P)^-1 H.
        """
        total = np.zeros((6, 6))
        if len(self.owner):
            order = np.argsort(self.owner, kind="stable")
            ids, starts = np.unique(self.owner[order], return_index=True)
            J, weights = evaluation.jacobian[order].astype(np.float64), evaluation.weights[order, None]
            H = np.add.reduceat((weights * J)[:, :, None] * J[:, None, :], starts)  # of each landmark
            landmarks = [self.world.landmarks[int(one)] for one in ids]
            by_camera = np.stack([object_by_camera(one.state.pose, T) for one in landmarks])
            doubts = np.stack([one.doubt for one in landmarks])
            known = by_camera.transpose(0, 2, 1) @ np.linalg.solve(doubts, by_camera)
            total = (H - H @ np.linalg.solve(H + known, H)).sum(axis=0)
        if self.config.use_plane and len(self.pixels.plane_points):
            _, jacobian, weight = self._plane_rows(T)
            total += jacobian.T @ (weight[:, None] * jacobian)
        return (total + total.T) / 2

    def shares(self, evaluation: Evaluation) -> dict[int, float]:
        """Of every landmark with enough pixels on it: how many of them agree with the rendering."""
        shares = {}
        residual = evaluation.residuals[: len(self.owner)]
        for one in self.seen:
            own = self.is_object & (self.owner == one)
            if own.sum() >= self.config.min_pixels:
                shares[one] = float((np.abs(residual[own]) < self.config.inlier).mean())
        return shares


def _orthonormal(T: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(T[:3, :3])
    out = np.array(T)
    out[:3, :3] = u @ vt
    return out
