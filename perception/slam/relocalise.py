"""Relocalisation: the camera pose from one frame and the map, without a prediction.

Each mask gives a point, the centre of its object's footprint. The support plane fitted to the frame
determines tilt and height, so the pose has three degrees of freedom left, and a pair of masks matched to a
pair of landmarks of compatible classes determines them. Hypotheses that explain most masks are refined by
tracking; the one with most agreeing landmarks wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from perception.detection.geometry import points_of
from perception.errors import PerceptionError
from perception.geometry import rigid
from perception.slam.labelled_frame import LabelledFrame, with_pose
from perception.slam.landmarks import LandmarkMap, log_probabilities
from perception.slam.pixels import PixelSelectionConfig, select_pixels
from perception.slam.tracking import TrackedPose, TrackingConfig, track
from perception.support.planes import PlaneConfig
from perception.support.surfaces import SurfaceConfig
from perception.support_plane import fit_support_plane
from perception.types import CATEGORIES, ObjectDetection, RgbdFrame, SupportPlane

_ANY_TILT = SurfaceConfig(planes=PlaneConfig(max_tilt=np.pi))
_REFINEMENT_SIGMA = 1.0  # [rad], [m] of a hypothesis: weak enough for the frame alone to determine the pose
_REFINEMENT_ITERATIONS = 12
_EARLY_STOP_RATIO = 0.8  # median inlier ratio from which a pose that explains all matches is accepted at once
_UNLIKELY = -3.5  # log probability ratio below which mask and landmark are of different classes
_MIN_HEIGHT = 0.005  # [m] above the plane: lower points may be of the table
_MIN_POINTS = 30
_EXTENT_QUANTILES = (0.02, 0.98)


@dataclass(frozen=True)
class RelocalisationConfig:
    """Thresholds of the search.

    Attributes:
        position_tolerance: Distance in the plane between the footprint of a mask and its landmark, in metres.
        min_baseline: Least distance between the two masks of a hypothesis, in metres.
        max_candidates: Number of hypotheses refined by tracking.
        min_matches: Least number of masks that match a landmark.
        min_inlier_ratio: Inlier ratio above which a landmark agrees, and least median over the landmarks.
    """

    position_tolerance: float = 0.05
    min_baseline: float = 0.08
    max_candidates: int = 6
    min_matches: int = 3
    min_inlier_ratio: float = 0.6


@dataclass(frozen=True)
class Relocalisation:
    """Result of a relocalisation: the refined pose, and the frame with its pose and association."""

    tracked: TrackedPose
    view: LabelledFrame


@dataclass(frozen=True)
class _Hypothesis:
    """A planar pose and the matches that it explains.

    Attributes:
        rotation: Rotation from the camera's level frame to the map's.
        translation: Translation of the same, in metres.
        matches: Index of the landmark of each matched detection.
    """

    rotation: Float[np.ndarray, "2 2"]
    translation: Float[np.ndarray, "2"]
    matches: dict[int, int]

    @property
    def T_maplevel_level(self) -> Float[np.ndarray, "4 4"]:
        T = rigid(np.eye(3), np.zeros(3))
        T[:2, :2], T[:2, 3] = self.rotation, self.translation
        return T


def relocalise(
    world: LandmarkMap,
    view: LabelledFrame,
    tracking: TrackingConfig,
    selection: PixelSelectionConfig,
    config: RelocalisationConfig = RelocalisationConfig(),
) -> Relocalisation | None:
    """Find the camera pose of a frame; None if the frame does not determine it.

    Args:
        world: The map.
        view: The frame and its masks; a pose or association is ignored.
        tracking: Settings of the refinement.
        selection: Settings of the pixel selection.
        config: Thresholds of the search.
    """
    try:
        plane = fit_support_plane([with_pose(view.frame, np.eye(4))], _ANY_TILT)
    except PerceptionError:
        return None
    T_level_camera, T_maplevel_world = T_level_from_plane(plane), T_level_from_plane(world.plane)
    footprints = [_footprint_centre(view.frame, found, T_level_camera) for found in view.detections]
    origins = [world.landmarks[id].state.pose.translation for id in world.ids]
    places = np.array([T_maplevel_world[:2, :3] @ origin for origin in origins])
    n_footprints = sum(centre is not None for centre in footprints)
    if n_footprints < config.min_matches or len(places) < config.min_matches:
        return None
    class_scores = _class_scores(world, view.detections)
    refinement = replace(
        tracking,
        rotation_sigma=_REFINEMENT_SIGMA,
        translation_sigma=_REFINEMENT_SIGMA,
        iterations=_REFINEMENT_ITERATIONS,
    )
    best: Relocalisation | None = None
    for hypothesis in _hypotheses(footprints, places, class_scores, config)[: config.max_candidates]:
        if len(hypothesis.matches) < config.min_matches:
            break
        T = np.linalg.inv(T_maplevel_world) @ hypothesis.T_maplevel_level @ T_level_camera
        landmark_of = {k + 1: world.ids[place] for k, place in hypothesis.matches.items()}
        posed = replace(view.with_pose(T), landmark_of=landmark_of)
        tracked = track(world, select_pixels(posed, world.plane, selection), T, refinement)
        n_agreeing = _n_agreeing(tracked, config)
        if tracked.median_inlier_ratio < config.min_inlier_ratio or n_agreeing < config.min_matches:
            continue
        if best is None or (n_agreeing, tracked.median_inlier_ratio) > (
            _n_agreeing(best.tracked, config),
            best.tracked.median_inlier_ratio,
        ):
            best = Relocalisation(tracked, posed.with_pose(tracked.T_world_camera))
        if n_agreeing == len(hypothesis.matches) and tracked.median_inlier_ratio > _EARLY_STOP_RATIO:
            break
    return best


def _n_agreeing(tracked: TrackedPose, config: RelocalisationConfig) -> int:
    return sum(ratio > config.min_inlier_ratio for ratio in tracked.inlier_ratios.values())


def T_level_from_plane(plane: SupportPlane) -> Float[np.ndarray, "4 4"]:
    """Return the transform from the frame of a plane's coordinates to a level one: z = 0 on the plane."""
    n = plane.normal / np.linalg.norm(plane.normal)
    seed = np.array([1.0, 0.0, 0.0]) if abs(n[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = seed - (seed @ n) * n
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(n, x), n])
    return rigid(R, np.array([0.0, 0.0, -plane.offset]))


def _footprint_centre(
    frame: RgbdFrame, found: ObjectDetection, T_level_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "2"] | None:
    """Return the centre of an object's footprint in the level frame, in metres; None with too few points.

    It lies half of the visible width behind the nearest points, or in the middle of the visible depth if that
    is farther.
    """
    points = points_of(with_pose(frame, T_level_camera), found.mask)
    points = points[points[:, 2] > _MIN_HEIGHT]
    if len(points) < _MIN_POINTS:
        return None
    flat = points[:, :2]
    ahead = flat.mean(axis=0) - T_level_camera[:2, 3]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-6)
    across = np.array([-ahead[1], ahead[0]])
    low, high = np.quantile(flat @ across, _EXTENT_QUANTILES)
    near, far = np.quantile(flat @ ahead, _EXTENT_QUANTILES)
    behind = max(near + (high - low) / 2, (near + far) / 2)
    return (low + high) / 2 * across + behind * ahead


def _class_scores(world: LandmarkMap, detections: Sequence[ObjectDetection]) -> Float[np.ndarray, "d l"]:
    """Return the log odds of each landmark's class against the best class of each detection."""
    scores = np.zeros((len(detections), len(world.ids)))
    categories = [CATEGORIES.index(world.landmarks[id].category) for id in world.ids]
    for row, found in enumerate(detections):
        log = log_probabilities(found)
        scores[row] = [log[category] - log.max() for category in categories]
    return scores


def _hypotheses(
    footprints: Sequence[Float[np.ndarray, "2"] | None],
    places: Float[np.ndarray, "l 2"],
    class_scores: Float[np.ndarray, "d l"],
    config: RelocalisationConfig,
) -> list[_Hypothesis]:
    """Return distinct hypotheses, those that explain the masks best first.

    Args:
        footprints: Footprint centre of each detection in the camera's level frame, if it has one.
        places: Position of each landmark in the map's level frame, in metres.
        class_scores: Relative log probability of each landmark's class under each detection.
        config: Thresholds.
    """
    valid = [i for i, centre in enumerate(footprints) if centre is not None]
    centres = np.array([footprints[i] for i in valid])
    tolerance = config.position_tolerance
    scored: list[tuple[float, dict[int, int]]] = []
    distances = np.linalg.norm(places[:, None] - places, axis=-1)
    for a in range(len(valid)):
        for b in range(a):
            length = float(np.linalg.norm(centres[a] - centres[b]))
            if length < config.min_baseline:
                continue
            for p, q in np.argwhere(np.abs(distances - length) < tolerance):
                if p == q or class_scores[valid[a], p] < _UNLIKELY or class_scores[valid[b], q] < _UNLIKELY:
                    continue
                rotation, translation = _align_planar(centres[[a, b]], places[[p, q]])
                moved = centres @ rotation.T + translation
                score, matches = _match_places(moved, places, class_scores[valid], tolerance)
                scored.append((score, {valid[i]: j for i, j in matches.items()}))
    scored.sort(key=lambda entry: -entry[0])
    result: list[_Hypothesis] = []
    seen = set()
    for _, matches in scored:
        key = tuple(sorted(matches.items()))
        if key in seen or len(matches) < 2:
            continue
        seen.add(key)
        source = np.array([footprints[i] for i in matches])
        result.append(_Hypothesis(*_align_planar(source, places[list(matches.values())]), matches))
        if len(result) == 2 * config.max_candidates:
            break
    return result


def _align_planar(
    source: Float[np.ndarray, "n 2"], target: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "2"]]:
    """Return the rotation and translation that best align points with others (Kabsch)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    H = (source - a).T @ (target - b)
    angle = np.arctan2(H[0, 1] - H[1, 0], H[0, 0] + H[1, 1])
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rotation, b - rotation @ a


def _match_places(
    points: Float[np.ndarray, "n 2"],
    places: Float[np.ndarray, "l 2"],
    class_scores: Float[np.ndarray, "n l"],
    tolerance: float,
) -> tuple[float, dict[int, int]]:
    """Return the score of the best one-to-one assignment of points to places, and the assignment.

    A pair scores 1, less for its distance and for an unlikely class; distant or incompatible pairs score 0.
    """
    distance = np.linalg.norm(points[:, None] - places, axis=-1)
    compatible = (distance < 1.5 * tolerance) & (class_scores > _UNLIKELY)
    gain = np.where(compatible, 1 - 0.3 * distance / tolerance + 0.1 * class_scores, 0.0)
    rows, columns = linear_sum_assignment(-gain)
    matches = {int(r): int(c) for r, c in zip(rows, columns) if gain[r, c] > 0}
    return float(sum(gain[r, c] for r, c in matches.items())), matches
