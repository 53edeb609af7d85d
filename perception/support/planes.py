"""Candidate planes of the samples: RANSAC, plane after plane, each refined by total least squares.

Three samples span a hypothesis if their normals agree with it. Half of the triples come from anywhere, half
are neighbours in the image, since a small table would seldom get three samples out of all. Samples of the
best plane are removed, the others decide about the next plane. Where no hypothesis has enough of them, new
hypotheses are drawn among them, which finds small surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from perception.support.samples import Samples, depth_noise
from perception.types import SupportPlane


@dataclass(frozen=True)
class PlaneConfig:
    """Parameters of the plane fit.

    Attributes:
        max_points: Number of depth points over all frames.
        min_points: Smallest number of points of a frame.
        draws: Number of draws of hypotheses, each among the samples of no plane yet.
        iterations: Number of triples of samples in a draw, most of which do not agree with the normals.
        neighbourhood: Largest distance of neighbours along rows and columns, as a share of the image's width.
        max_hypotheses: Largest number of hypotheses of a draw that are scored.
        judges: Number of points on which each hypothesis is scored.
        threshold: Largest distance of an inlier from a hypothesis where depth noise is smaller, in metres.
        max_normal_angle: Largest angle between the normal of an inlier and that of the plane, in radians.
        min_share: Smallest share of inliers of a plane.
        max_planes: Largest number of candidate planes.
        max_tilt: Largest angle between the normal and world z for frames with poses, in radians.
        max_depth: Largest depth of a point, in metres.
    """

    max_points: int = 20_000
    min_points: int = 4000
    draws: int = 2
    iterations: int = 1500
    neighbourhood: float = 0.1
    max_hypotheses: int = 400
    judges: int = 1500
    threshold: float = 0.006
    max_normal_angle: float = 0.6
    min_share: float = 0.015
    max_planes: int = 8
    max_tilt: float = 0.35
    max_depth: float = 3.0


def tolerance(samples: Samples, config: PlaneConfig) -> Float[np.ndarray, "n"]:
    """Return the largest distance of each sample from a plane that it lies on, in metres."""
    return np.maximum(np.float32(config.threshold), 3 * depth_noise(samples.depth))


def on_plane(
    samples: Samples, plane: SupportPlane, config: PlaneConfig, widening: float = 1.0
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return which samples lie on the plane and agree with its normal, and the height of all, in metres."""
    normal = plane.normal.astype(np.float32)
    height = samples.points @ normal - np.float32(plane.offset)
    near = samples.valid & (np.abs(height) < widening * tolerance(samples, config))
    return near & (samples.normals @ normal > np.cos(config.max_normal_angle)), height


def candidate_planes(
    samples: Samples, posed: bool, config: PlaneConfig, rng: np.random.Generator
) -> list[SupportPlane]:
    """Return the planes with the most samples, most first; normals point towards the cameras.

    Args:
        samples: Samples of all frames.
        posed: Whether world z points up.
        config: Parameters.
        rng: Random numbers.
    """
    free = samples.valid.copy()  # samples of no plane yet
    needed = config.min_share * float(free.sum())
    planes: list[SupportPlane] = []
    for _ in range(config.draws):
        planes += _planes_among(samples, free, needed, config.max_planes - len(planes), posed, config, rng)
    return planes


def _planes_among(
    samples: Samples,
    free: Bool[np.ndarray, "n"],
    needed: float,
    count: int,
    posed: bool,
    config: PlaneConfig,
    rng: np.random.Generator,
) -> list[SupportPlane]:
    """Return up to ``count`` planes of ``needed`` free samples, which are then no longer free (in place)."""
    normals, offsets = _hypotheses(samples, free, posed, config, rng)
    if not len(normals):
        return []
    known = np.flatnonzero(free)
    judges = known[rng.integers(len(known), size=config.judges)]
    inside = _inliers(samples, judges, normals, offsets, config)
    least = needed * config.judges / len(known)
    planes: list[SupportPlane] = []
    while len(planes) < count:
        votes = free[judges].astype(np.float32) @ inside
        best = int(votes.argmax())
        if votes[best] < least:
            break
        first = SupportPlane(normals[best], float(offsets[best]))
        plane = refined(samples, first, config, rounds=3, among=free)
        for found in (first, plane):
            distance = np.abs(samples.points @ found.normal.astype(np.float32) - np.float32(found.offset))
            free &= distance > tolerance(samples, config)
        planes.append(plane)
    return planes


def _hypotheses(
    samples: Samples,
    free: Bool[np.ndarray, "n"],
    posed: bool,
    config: PlaneConfig,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k"]]:
    """Return normals and offsets of planes through three free samples that agree with their normals."""
    usable = np.flatnonzero(free & (samples.normals != 0).any(1))
    if len(usable) < 3:
        return np.zeros((0, 3)), np.zeros(0)
    triples = usable[rng.integers(len(usable), size=(3, config.iterations))]
    first = triples[0, : config.iterations // 2]
    columns = np.array([columns for _, columns in samples.shapes])[samples.view[first]]
    rows_off, columns_off = rng.uniform(-config.neighbourhood, config.neighbourhood, (2, 2, len(first)))
    steps = np.rint(rows_off * columns) * columns + np.rint(columns_off * columns)
    triples[1:, : len(first)] = np.clip(first + steps.astype(np.int64), 0, len(samples.valid) - 1)
    a, b, c = samples.points[triples].astype(np.float64)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(length, 1e-12)[:, None]
    own = samples.normals[triples]  # 0 where unknown: in agreement with none
    agree = np.einsum("tkj,kj->tk", own, normals)
    flip = np.where(agree[0] < 0, -1.0, 1.0)
    keep = (length > 1e-6) & (agree * flip > np.cos(config.max_normal_angle)).all(0)
    normals *= flip[:, None]
    if posed:
        keep &= normals[:, 2] > np.cos(config.max_tilt)
    kept = np.flatnonzero(keep)
    kept = kept[:: len(kept) // config.max_hypotheses + 1]
    return normals[kept], np.einsum("kj,kj->k", normals[kept], a[kept])


def _inliers(
    samples: Samples,
    judges: np.ndarray,
    normals: Float[np.ndarray, "k 3"],
    offsets: Float[np.ndarray, "k"],
    config: PlaneConfig,
) -> Float[np.ndarray, "m k"]:
    """Return 1 for each judge that lies on a hypothesis and agrees with its normal, else 0."""
    n = np.ascontiguousarray(normals.T, np.float32)
    distance = samples.points[judges] @ n
    distance -= offsets.astype(np.float32)
    np.abs(distance, out=distance)
    inside = distance < tolerance(samples, config)[judges, None]
    inside &= samples.normals[judges] @ n > np.float32(np.cos(config.max_normal_angle))
    return inside.astype(np.float32)


def refined(
    samples: Samples,
    plane: SupportPlane,
    config: PlaneConfig,
    rounds: int = 4,
    among: Bool[np.ndarray, "n"] | None = None,
) -> SupportPlane:
    """Refine by total least squares on the samples within three robust standard deviations, iterated.

    Args:
        samples: Samples of all frames.
        plane: First estimate.
        config: Parameters.
        rounds: Number of iterations.
        among: Samples that may be used; all if None.
    """
    band = tolerance(samples, config)
    usable, _ = on_plane(samples, plane, config, 2.0)
    near = np.flatnonzero(usable if among is None else usable & among)
    points, band = samples.points[near].astype(np.float64), band[near].astype(np.float64)
    normal, offset, share = plane.normal, plane.offset, 1.0
    for _ in range(rounds):
        inside = np.abs(points @ normal - offset) < share * band
        inliers = points[inside]
        if len(inliers) < 3:
            break
        mean = inliers.mean(0)
        centred = inliers - mean
        solved = np.linalg.svd(centred.T @ centred)[0][:, 2]
        normal = solved if solved @ normal > 0 else -solved
        offset = float(normal @ mean)
        spread = 1.4826 * float(np.median(np.abs(inliers @ normal - offset) / band[inside]))
        share = float(np.clip(3 * spread, 0.17, 1))
    return SupportPlane(normal, offset)
