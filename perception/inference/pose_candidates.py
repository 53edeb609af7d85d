"""Poses of a known shape that depth images agree with, by search over orientations and places.

Upright, upside down, lying and leaning orientations are tried at every place where something is that no other
object explains: resting on the support, and with their top at the height that is measured there. The best
are moved and turned a little, and those that differ are returned.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter

from perception.geometry import pose_from_yaw, rigid, so3_log
from perception.inference.depth_votes import DepthVotes, VisibleSamples
from perception.metrics import SurfaceSamples
from perception.types import ObjectEstimate, SupportPlane

COARSE, FINE = 0.02, 0.012  # [m] of depth that agrees, in the two passes
ROUND = 1.12  # largest ratio of the widths of a shape without a handle or corners
SHAPE_SAMPLES = 1500  # points on the surface from which its extent is taken


@dataclass(frozen=True)
class CandidateConfig:
    """Settings of the search.

    Attributes:
        cell: Distance between places, in metres.
        cell_points: Least number of points at a place.
        n_yaws, n_rolls: Numbers of rotations of what is not round: about the vertical if it stands, about its
            axis if not.
        n_azimuths: Numbers of directions of the axis of what does not stand, round and not round.
        leans: Elevations of the axis of what does not stand, in radians.
        lean_penalty: By how much the score of what leans counts less.
        samples: Numbers of points on the surface in the two passes.
        per_orientation: Number of places that are kept of each orientation.
        n_coarse, n_fine: Largest numbers of candidates after the two passes.
        coarse_apart, fine_apart: Least distance in metres, or angle in radians, between them.
        steps: Offsets of the second pass across and along the vertical, in metres.
        turn: Offset of the yaw of what is not round there, in radians.
        min_score: Least score.
    """

    cell: float = 0.02
    cell_points: int = 3
    n_yaws: int = 12
    n_azimuths: tuple[int, int] = (24, 12)
    n_rolls: int = 6
    leans: tuple[float, ...] = (-np.pi / 3, -np.pi / 6, 0.0, np.pi / 6, np.pi / 3)
    lean_penalty: float = 0.05
    samples: tuple[int, int] = (120, 300)
    per_orientation: int = 6
    n_coarse: int = 40
    n_fine: int = 6
    coarse_apart: tuple[float, float] = (0.015, np.pi / 12)
    fine_apart: tuple[float, float] = (0.03, np.pi / 7)
    steps: tuple[float, float] = (0.01, 0.008)
    turn: float = np.pi / 12
    min_score: float = 0.2


@dataclass(frozen=True)
class Candidate:
    """A pose with its score (``DepthVotes.score``)."""

    score: float
    T_world_object: Float[np.ndarray, "4 4"]


def pose_candidates(
    estimate: ObjectEstimate,
    votes: DepthVotes,
    plane: SupportPlane = SupportPlane(),
    config: CandidateConfig = CandidateConfig(),
) -> list[Candidate]:
    """Return poses that the images agree with and that differ from each other, the best first.

    Args:
        estimate: Object of known shape; its pose is not used.
        votes: Images of the scene.
        plane: Support plane.
        config: Settings.
    """
    places = _Places.of(votes.points, config)
    if places is None:
        return []
    samples = [VisibleSamples(estimate.mesh, count) for count in config.samples]
    surface = SurfaceSamples.of(estimate.mesh, np.random.default_rng(0), SHAPE_SAMPLES).points
    is_round = _is_round(surface)
    coarse: list[Candidate] = []
    wider = votes.widened(config.cell / 2)
    for R in _orientations(is_round, config):
        positions = places.positions(surface @ R.T, plane)
        scores = wider.score(samples[0], R, positions, COARSE) - _penalty(R, config)
        best = np.argsort(-scores)[: config.per_orientation]
        coarse += [Candidate(float(scores[k]), rigid(R, positions[k])) for k in best]
    coarse = _distinct(coarse, config.n_coarse, config.coarse_apart, is_round, config)
    fine = [_improved(candidate, samples[1], votes, is_round, config) for candidate in coarse]
    return _distinct(fine, config.n_fine, config.fine_apart, is_round, config)


def _is_round(surface: Float[np.ndarray, "m 3"]) -> bool:
    """Return whether a surface is about as wide in all directions across its axis."""
    turns = np.pi * np.arange(12) / 12
    widths = np.ptp(surface[:, :2] @ np.stack([np.cos(turns), np.sin(turns)]), axis=0)
    return bool(widths.max() < ROUND * widths.min())


@dataclass(frozen=True)
class _Places:
    """Centres of cells of the top view in [m], and the largest height of the points there."""

    centres: Float[np.ndarray, "k 2"]
    heights: Float[np.ndarray, "k"]

    @staticmethod
    def of(points: Float[np.ndarray, "n 3"], config: CandidateConfig) -> _Places | None:
        """Return the cells with points, and those beside them: what lies on top may cover the middle."""
        if len(points) == 0:
            return None
        low = points[:, :2].min(axis=0) - 1.5 * config.cell
        cells = np.floor((points[:, :2] - low) / config.cell).astype(int)
        size = cells.max(axis=0) + 2
        heights, counts = np.full(size, -np.inf), np.zeros(size, int)
        np.maximum.at(heights, tuple(cells.T), points[:, 2])
        np.add.at(counts, tuple(cells.T), 1)
        filled = counts >= config.cell_points
        around = maximum_filter(np.where(filled, heights, -np.inf), 3)
        chosen = np.argwhere(np.isfinite(around))
        if len(chosen) == 0:
            return None
        at = tuple(chosen.T)
        return _Places(low + (chosen + 0.5) * config.cell, np.where(filled, heights, around)[at])

    def positions(self, turned: Float[np.ndarray, "m 3"], plane: SupportPlane) -> Float[np.ndarray, "k 3"]:
        """Return where the origin of a turned surface is if it is centred at the places.

        At each it rests on the support, and where more is measured, its top is at the measured height too.
        """
        middle = (turned[:, :2].min(axis=0) + turned[:, :2].max(axis=0)) / 2
        inner = np.linalg.norm(turned[:, :2] - middle, axis=1) < 0.6 * COARSE
        top = turned[inner, 2].max() if inner.any() else turned[:, 2].max()
        support = (plane.offset - self.centres @ plane.normal[:2]) / plane.normal[2]
        resting, topped = support - turned[:, 2].min(), self.heights - top
        above = topped > resting + FINE
        return np.concatenate(
            [
                np.column_stack([self.centres - middle, resting]),
                np.column_stack([self.centres - middle, topped])[above],
            ]
        )


def _orientations(is_round: bool, config: CandidateConfig) -> Iterator[Float[np.ndarray, "3 3"]]:
    """Yield rotations: upright and upside down over all yaws, lying and leaning over azimuths and rolls."""
    upside_down = np.diag([1.0, -1.0, -1.0])
    for yaw in 2 * np.pi * np.arange(1 if is_round else config.n_yaws) / config.n_yaws:
        yield _yaw(yaw)
        yield _yaw(yaw) @ upside_down
    rolls = 2 * np.pi * np.arange(1 if is_round else config.n_rolls) / config.n_rolls
    n_azimuths = config.n_azimuths[0 if is_round else 1]
    azimuths = 2 * np.pi * np.arange(n_azimuths) / n_azimuths
    for azimuth, lean, roll in itertools.product(azimuths, config.leans, rolls):
        c, s = np.cos(lean), np.sin(lean)
        lying = np.array([[s, 0.0, c], [0.0, 1.0, 0.0], [-c, 0.0, s]])  # z of the object along x, raised
        yield _yaw(azimuth) @ lying @ _yaw(roll)


def _penalty(R: Float[np.ndarray, "3 3"], config: CandidateConfig) -> float:
    """Return the penalty of an orientation that neither stands nor lies."""
    return config.lean_penalty if 0.1 < abs(R[2, 2]) < 0.9 else 0.0


def _improved(
    candidate: Candidate, samples: VisibleSamples, votes: DepthVotes, is_round: bool, config: CandidateConfig
) -> Candidate:
    """Return the best of the poses around a candidate."""
    across, up = config.steps
    signs = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    positions = candidate.T_world_object[:3, 3] + signs * (across, across, up)
    best: list[Candidate] = []
    for turn in (0.0,) if is_round else (-config.turn, 0.0, config.turn):
        R = candidate.T_world_object[:3, :3] @ _yaw(turn)
        scores = votes.score(samples, R, positions, FINE) - _penalty(R, config)
        k = int(np.argmax(scores))
        best.append(Candidate(float(scores[k]), rigid(R, positions[k])))
    return max(best, key=lambda found: found.score)


def _distinct(
    candidates: list[Candidate],
    count: int,
    apart: tuple[float, float],
    is_round: bool,
    config: CandidateConfig,
) -> list[Candidate]:
    """Return the best candidates that are apart in position or direction, or in yaw if not round."""
    kept: list[Candidate] = []

    def is_new(T: Float[np.ndarray, "4 4"]) -> bool:
        for other in kept:
            S = other.T_world_object
            turn = np.arccos(np.clip(T[:3, 2] @ S[:3, 2], -1, 1))
            if not is_round:
                turn = max(turn, float(np.linalg.norm(so3_log(T[:3, :3].T @ S[:3, :3]))) - config.turn)
            if np.linalg.norm(T[:3, 3] - S[:3, 3]) < apart[0] and turn < apart[1]:
                return False
        return True

    for candidate in sorted(candidates, key=lambda found: -found.score):
        if candidate.score < config.min_score or len(kept) == count:
            break
        if is_new(candidate.T_world_object):
            kept.append(candidate)
    return kept


def _yaw(angle: float) -> Float[np.ndarray, "3 3"]:
    return pose_from_yaw(angle, np.zeros(3))[:3, :3]
