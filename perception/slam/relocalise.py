"""Where the camera is when nothing is known but the map: objects by class and place, then tracking decides.

Each mask gives a point: its cloud's middle, pushed behind the visible surface by the object's radius. The
support plane found in the frame itself tells tilt and height, so pairs of masks and landmarks of fitting
classes give a pose in the plane; those that explain most masks are refined by tracking, and the one that
most pixels agree with wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import linear_sum_assignment

from perception.detection.geometry import points_of
from perception.errors import PerceptionError
from perception.geometry import rigid
from perception.slam.keyframes import with_pose
from perception.slam.landmarks import LandmarkMap, log_probabilities
from perception.slam.pixels import SelectionConfig, select_pixels
from perception.slam.tracking import TrackedPose, TrackingConfig, track
from perception.support_plane import PlaneConfig, fit_support_plane
from perception.types import CATEGORIES, ObjectDetection, RgbdFrame, SupportPlane


@dataclass(frozen=True)
class RelocalisationConfig:
    """How a pose is searched.

    Attributes:
        tolerance: between a mask's place and its landmark's, seen from above [m].
        separation: of the two masks that a hypothesis is made from, at least [m].
        candidates: hypotheses that are refined by tracking.
        min_matches: masks that must find their landmark.
        min_share: of the pixels that must agree after tracking, as the median over the objects.
    """

    tolerance: float = 0.05
    separation: float = 0.08
    candidates: int = 6
    min_matches: int = 3
    min_share: float = 0.6


@dataclass(frozen=True)
class Relocalised:
    """A pose that the map and the frame agree on, the masks, and which of them shows which landmark."""

    tracked: TrackedPose
    labels: UInt8[np.ndarray, "h w"]
    landmark_of: dict[int, int]


def relocalise(
    world: LandmarkMap,
    frame: RgbdFrame,
    detections: Sequence[ObjectDetection],
    labels: UInt8[np.ndarray, "h w"],
    tracking: TrackingConfig,
    selection: SelectionConfig,
    config: RelocalisationConfig = RelocalisationConfig(),
) -> Relocalised | None:
    """The camera's pose from one frame, or None if it cannot be told."""
    try:
        seen_plane = fit_support_plane([with_pose(frame, np.eye(4))], _ANY_TILT)
    except PerceptionError:
        return None
    T_level_camera = level_camera(seen_plane)
    spots = [_spot(frame, found, T_level_camera) for found in detections]
    T_world_level = level_camera(world.plane)  # maps the world into the map's own level frame
    places = np.array([T_world_level[:2, :3] @ world.landmarks[i].state.pose.translation for i in world.ids])
    if sum(spot is not None for spot in spots) < config.min_matches or len(places) < config.min_matches:
        return None
    fits = _class_fits(world, detections)
    hypotheses = _hypotheses(spots, places, fits, config)
    best: Relocalised | None = None
    for turn, move, matches in hypotheses[: config.candidates]:
        if len(matches) < config.min_matches:
            break
        T_level = rigid(np.eye(3), np.zeros(3))
        T_level[:2, :2], T_level[:2, 3] = turn, move
        T = np.linalg.inv(T_world_level) @ T_level @ T_level_camera
        landmark_of = {spot + 1: world.ids[place] for spot, place in matches.items()}
        loose = replace(tracking, turn_sigma=1.0, move_sigma=1.0, iterations=12)
        pixels = select_pixels(frame, labels, landmark_of, T, world.plane, selection)
        tracked = track(world, pixels, T, loose)
        agree = sum(share > config.min_share for share in tracked.shares.values())
        if tracked.share < config.min_share or agree < config.min_matches:
            continue
        if best is None or (agree, tracked.share) > (_agreeing(best, config), best.tracked.share):
            best = Relocalised(tracked, labels, landmark_of)
        if agree == len(matches) and tracked.share > 0.8:
            break
    return best


_ANY_TILT = PlaneConfig(max_tilt=np.pi)


def _agreeing(found: Relocalised, config: RelocalisationConfig) -> int:
    return sum(share > config.min_share for share in found.tracked.shares.values())


def level_camera(plane: SupportPlane) -> Float[np.ndarray, "4 4"]:
    """Maps the frame that the plane is given in to one whose z is the plane's normal, with height 0 on it."""
    n = plane.normal / np.linalg.norm(plane.normal)
    seed = np.array([1.0, 0.0, 0.0]) if abs(n[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = seed - (seed @ n) * n
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(n, x), n])
    return rigid(R, np.array([0.0, 0.0, -plane.offset]))


def _spot(
    frame: RgbdFrame, found: ObjectDetection, T_level_camera: np.ndarray
) -> Float[np.ndarray, "2"] | None:
    """About the middle of an object seen from above, in the level frame: behind what the mask shows."""
    points = points_of(with_pose(frame, T_level_camera), found.mask)
    points = points[points[:, 2] > 0.005]
    if len(points) < 30:
        return None
    flat = points[:, :2]
    eye = T_level_camera[:2, 3]
    ahead = flat.mean(axis=0) - eye
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-6)
    across = np.array([-ahead[1], ahead[0]])
    low, high = np.quantile(flat @ across, (0.02, 0.98))
    near, far = np.quantile(flat @ ahead, (0.02, 0.98))
    behind = max(near + (high - low) / 2, (near + far) / 2)
    return (low + high) / 2 * across + behind * ahead


def _class_fits(world: LandmarkMap, detections: Sequence[ObjectDetection]) -> np.ndarray:
    """(detections, landmarks) log probability that a mask is of the landmark's class, 0 at best."""
    fits = np.zeros((len(detections), len(world.ids)))
    for row, found in enumerate(detections):
        log = log_probabilities(found)
        fits[row] = [log[CATEGORIES.index(world.landmarks[i].category)] - log.max() for i in world.ids]
    return fits


def _hypotheses(
    spots: list[np.ndarray | None], places: np.ndarray, fits: np.ndarray, config: RelocalisationConfig
) -> list[tuple[np.ndarray, np.ndarray, dict[int, int]]]:
    """Planar poses (turn, move) with their matches, those with the most and best ones first."""
    known = [i for i, spot in enumerate(spots) if spot is not None]
    at = np.array([spots[i] for i in known])
    found: list[tuple[float, np.ndarray, np.ndarray, dict[int, int]]] = []
    gaps = np.linalg.norm(places[:, None] - places, axis=-1)
    for a in range(len(known)):
        for b in range(a):
            length = float(np.linalg.norm(at[a] - at[b]))
            if length < config.separation:
                continue
            pairs = np.argwhere(np.abs(gaps - length) < config.tolerance)
            for p, q in pairs:
                if p == q or fits[known[a], p] < _UNLIKELY or fits[known[b], q] < _UNLIKELY:
                    continue
                turn, move = _planar(at[[a, b]], places[[p, q]])
                score, matches = _explained(at @ turn.T + move, places, fits[known], config.tolerance)
                found.append((score, turn, move, {known[i]: j for i, j in matches.items()}))
    found.sort(key=lambda entry: -entry[0])
    result, seen = [], set()
    for _, _, _, matches in found:
        key = tuple(sorted(matches.items()))
        if key in seen or len(matches) < 2:
            continue
        seen.add(key)
        chosen = list(matches)
        turn, move = _planar(np.array([spots[i] for i in chosen]), places[[matches[i] for i in chosen]])
        result.append((turn, move, matches))
        if len(result) == 2 * config.candidates:
            break
    return result


_UNLIKELY = -3.5  # log probability under which two things are of different classes


def _planar(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The planar motion that takes points nearest to others (Kabsch)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    H = (source - a).T @ (target - b)
    angle = np.arctan2(H[0, 1] - H[1, 0], H[0, 0] + H[1, 1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn, b - turn @ a


def _explained(
    moved: np.ndarray, places: np.ndarray, fits: np.ndarray, tolerance: float
) -> tuple[float, dict[int, int]]:
    """How well points fall on places of fitting classes, and which on which."""
    distance = np.linalg.norm(moved[:, None] - places, axis=-1)
    gain = np.where(
        (distance < 1.5 * tolerance) & (fits > _UNLIKELY), 1 - 0.3 * distance / tolerance + 0.1 * fits, 0.0
    )
    rows, columns = linear_sum_assignment(-gain)
    matches = {int(r): int(c) for r, c in zip(rows, columns) if gain[r, c] > 0}
    return float(sum(gain[r, c] for r, c in matches.items())), matches
