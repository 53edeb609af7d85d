"""Collision checks for the hand alone: two fingers and a palm as boxes against surface points.

All poses and points are in a frame whose plane z = 0 is the support plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from manipulation.robot import GripperGeometry
from perception.types import TriangleMesh

_SPACING = 0.003  # [m] between neighbouring surface points
_ROUNDING = 1e-9  # [m]


@dataclass(frozen=True)
class HandClearance:
    """Clearances of the hand.

    Attributes:
        distance: distance kept from other objects, in metres.
        approach: length of the straight approach that must be free of collisions, in metres.
        hand_length: extent of the hand behind the palm, in metres.
    """

    distance: float = 0.003
    approach: float = 0.10
    hand_length: float = 0.10


@dataclass(frozen=True)
class HandBoxes:
    """The open hand as axis-aligned boxes in the TCP frame (y: closing direction, z: approach).

    Attributes:
        low, high: (b, 3) corners; of a whole hand two fingers and, last, the palm, in metres.
    """

    low: Float[np.ndarray, "b 3"]
    high: Float[np.ndarray, "b 3"]

    @staticmethod
    def of(gripper: GripperGeometry, opening: float, hand_length: float) -> HandBoxes:
        """Return the boxes of a hand whose pads are ``opening`` metres apart."""
        inner, outer = opening / 2, opening / 2 + gripper.finger_reach
        width, palm = gripper.finger_half_width, gripper.palm
        low = [
            (-width, inner, -palm),
            (-width, -outer, -palm),
            (-gripper.palm_half_width, -gripper.palm_half_length, -palm - hand_length),
        ]
        high = [
            (width, outer, gripper.tip),
            (width, -inner, gripper.tip),
            (gripper.palm_half_width, gripper.palm_half_length, -palm),
        ]
        return HandBoxes(np.array(low), np.array(high))

    def moved(self, distance: float) -> HandBoxes:
        """Return the boxes moved along the closing direction by a distance in metres."""
        step = np.array([0.0, distance, 0.0])
        return HandBoxes(self.low + step, self.high + step)

    @property
    def palm(self) -> HandBoxes:
        """The palm alone."""
        return HandBoxes(self.low[2:], self.high[2:])

    def contain(self, points_tcp: Float[np.ndarray, "n 3"], margin: float = 0.0) -> bool:
        """Return whether a point lies inside a box grown by ``margin`` metres on every side."""
        above = points_tcp[:, None] > self.low - margin
        below = points_tcp[:, None] < self.high + margin
        return bool((above & below).all(axis=2).any())

    def sweep_contains(
        self, points_tcp: Float[np.ndarray, "n 3"], sweep: Float[np.ndarray, "3"], margin: float = 0.0
    ) -> bool:
        """Return whether a grown box meets a point while it moves along ``sweep``."""
        return bool(self.swept(points_tcp, sweep, margin).any())

    def swept(
        self, points_tcp: Float[np.ndarray, "n 3"], sweep: Float[np.ndarray, "3"], margin: float = 0.0
    ) -> Bool[np.ndarray, "n"]:
        """Return which points a box grown by ``margin`` meets while it moves along ``sweep`` (slab method).

        The box, moved by s * sweep, contains p if low < p - s * sweep < high on every axis; each axis bounds
        s to an interval, and the intervals must have a point of [0, 1] in common.
        """
        step = np.where(np.abs(sweep) < 1e-9, 1e-9, sweep)
        low = self.low.min(axis=0) + np.minimum(sweep, 0.0) - margin - _ROUNDING
        high = self.high.max(axis=0) + np.maximum(sweep, 0.0) + margin + _ROUNDING
        met = ((points_tcp > low) & (points_tcp < high)).all(axis=1)
        first, last = np.array(-np.inf), np.array(np.inf)
        for axis, along in enumerate(points_tcp[met].T[..., None]):  # (n, 1); by axis, which is much faster
            to_high = (along - self.high[:, axis] - margin) / step[axis]
            to_low = (along - self.low[:, axis] + margin) / step[axis]
            first = np.maximum(first, np.minimum(to_high, to_low))
            last = np.minimum(last, np.maximum(to_high, to_low))
        met[met] = np.any((first < last) & (first < 1.0) & (last > 0.0), axis=1)
        return met

    def lowest(self, T_plane_tcp: Float[np.ndarray, "4 4"]) -> float:
        """Return the height of the lowest corner above the support plane in metres."""
        axis = T_plane_tcp[2, :3]
        return float(T_plane_tcp[2, 3] + np.minimum(self.low * axis, self.high * axis).sum(axis=1).min())


def hand_is_free(
    boxes: HandBoxes,
    T_plane_tcp: Float[np.ndarray, "4 4"],
    away: Float[np.ndarray, "3"],
    obstacles: Float[np.ndarray, "n 3"],
    clearance: HandClearance = HandClearance(),
) -> bool:
    """Return whether the hand meets neither the support plane nor an obstacle, at the grasp or before it.

    Args:
        boxes: the open hand.
        T_plane_tcp: (4, 4) TCP pose at the grasp.
        away: (3,) unit vector; the hand approaches along its negative.
        obstacles: (n, 3) surface points in metres.
        clearance: distance kept and length of the approach.
    """
    if boxes.lowest(T_plane_tcp) < 0:
        return False
    R = T_plane_tcp[:3, :3]
    points_tcp = (obstacles - T_plane_tcp[:3, 3]) @ R
    reach = np.maximum(np.abs(boxes.low), np.abs(boxes.high)).max() * np.sqrt(3) + clearance.approach
    points_tcp = points_tcp[np.linalg.norm(points_tcp, axis=1) < reach + clearance.distance]
    return not boxes.sweep_contains(points_tcp, clearance.approach * (away @ R), clearance.distance)


def surface_points(mesh: TriangleMesh) -> Float[np.ndarray, "n 3"]:
    """Return points on the mesh, about 3 mm apart: vertices, and lattice points inside larger triangles."""
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    divisions = np.ceil(longest / _SPACING).astype(int)
    points = [mesh.vertices]
    for n in np.unique(divisions[divisions > 1]):
        i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        weights = np.stack([i, j, n - i - j], axis=1) / n  # barycentric
        points.append(np.einsum("wc,tcx->twx", weights, corners[divisions == n]).reshape(-1, 3))
    return one_per_cell(np.concatenate(points), _SPACING)


def one_per_cell(points: Float[np.ndarray, "n 3"], cell: float) -> Float[np.ndarray, "m 3"]:
    """Return the first of the points in each cell of a grid, in their order.

    Args:
        points: the points in [m].
        cell: width of a cell in [m].
    """
    if not len(points):
        return points
    cells = np.floor(points / cell).astype(np.int64)
    cells -= cells.min(axis=0)
    number = np.ravel_multi_index(cells.T, cells.max(axis=0) + 1)  # sorts much faster than rows
    return points[np.sort(np.unique(number, return_index=True)[1])]
