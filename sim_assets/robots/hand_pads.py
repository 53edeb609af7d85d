"""Pads of a hand, and the motion of its joints over the opening between them."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int

from manipulation.robot import FingerMotion
from sim_assets.errors import RobotFileError
from sim_assets.robots.finger_motion import HandSweep

SLICE = 0.003  # [m] height of the slices across the approach
_PAD_DEPTH = 0.0015  # [m] by which points of a pad may lie behind its face


def find_pads(
    points: Float[np.ndarray, "k n 3"], left: Bool[np.ndarray, "n"], right: Bool[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "_a"], Int[np.ndarray, "_b"]]:
    """Return the points of both pads: where the fingers are nearest to each other in the closed hand.

    Args:
        points: at stations from closed to open or reverse, y along the closing direction, z the approach.
        left, right: those of the finger on the side of +y, and of the one of -y.

    Raises:
        RobotFileError: the fingers are not opposite to each other.
    """
    if not left.any() or not right.any():
        raise RobotFileError("the fingers do not move towards each other: check [gripper] joints")
    first, last = _gap(points[0], left, right), _gap(points[-1], left, right)
    closed, opened = (points[0], points[-1]) if first < last else (points[-1], points[0])
    bins = np.floor(closed[:, 2] / SLICE).astype(int)
    gaps, openings = {}, {}
    for b in np.intersect1d(bins[left], bins[right]).tolist():
        on_left, on_right = left & (bins == b), right & (bins == b)
        gaps[b] = closed[on_left, 1].min() - closed[on_right, 1].max()
        openings[b] = opened[on_left, 1].min() - opened[on_right, 1].max()
    # Brackets and linkages near the palm are close to each other in the opened hand as well.
    gaps = {b: gap for b, gap in gaps.items() if openings[b] > 0.5 * max(openings.values(), default=0.0)}
    if not gaps:
        raise RobotFileError("the fingers are not opposite to each other: check [gripper] joints")
    least = min(gaps.values())
    runs = _runs([b for b, gap in sorted(gaps.items()) if gap < least + 2 * _PAD_DEPTH])
    run = max(runs, key=lambda run: (run[1] - run[0] >= 2, run[1]))  # the one at the fingertips
    inside = (bins >= run[0]) & (bins <= run[1])
    face_left = closed[left & inside, 1].min()
    face_right = closed[right & inside, 1].max()
    on_left = left & inside & (closed[:, 1] < face_left + _PAD_DEPTH)
    on_right = right & inside & (closed[:, 1] > face_right - _PAD_DEPTH)
    return np.flatnonzero(on_left), np.flatnonzero(on_right)


def _gap(station: np.ndarray, left: np.ndarray, right: np.ndarray) -> float:
    return float(station[left, 1].mean() - station[right, 1].mean())


def _runs(values: list[int]) -> list[tuple[int, int]]:
    """Return first and last of each run of consecutive integers, one missing value allowed."""
    runs = [(values[0], values[0])]
    for before, value in itertools.pairwise(values):
        runs = [*runs[:-1], (runs[-1][0], value)] if value - before <= 2 else [*runs, (value, value)]
    return runs


def reversed_sweep(sweep: HandSweep) -> HandSweep:
    """Return a sweep with its stations in reverse order."""
    return HandSweep(sweep.joint_names, sweep.positions[::-1], sweep.qpos[::-1], sweep.n_driven)


def finger_motion(sweep: HandSweep, gaps: Float[np.ndarray, "k"]) -> FingerMotion:
    """Return the motion over increasing openings; pads that would penetrate each other count as closed."""
    widths, positions = [], []
    for gap, position in zip(gaps, sweep.positions, strict=True):
        if not widths or gap > widths[-1] + 1e-5:
            widths.append(float(gap))
            positions.append(position)
    table, columns = np.array(widths), np.array(positions)
    if table[0] < 0:
        at_zero = np.array([np.interp(0.0, table, column) for column in columns.T])
        keep = table > 1e-4
        table, columns = np.append(0.0, table[keep]), np.vstack([at_zero, columns[keep]])
    return FingerMotion(sweep.joint_names, table, columns, sweep.n_driven)
