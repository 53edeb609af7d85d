"""Seams of stacked objects: where one object ends and another one begins above, or inside, it.

Things that people stack are nearly bodies of revolution. The outline of a stack, the radius of its horizontal
sections over their height, is concave where one object stands on another: a waist, or a step outwards. Where
one stands in a bowl, the outline drops from the rim to the object inside. Single objects have such places,
too, the neck of a bottle for instance: seams are hypotheses, which fits of both parts must confirm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter

from perception.geometry import transform_points
from perception.inference.contents import circle, outermost
from perception.inference.initialise import plane_basis
from perception.inference.observation import ObjectObservation, measured_points, pixel_rays
from perception.types import SupportPlane

SLICE = 0.003  # [m] height of a section
_MIN_POINTS = 20  # of a section
_MIN_SECTORS = 8  # of 36 around a section that show its outline
_LOWEST = 4  # sections below which there is no seam
_HIGHEST = 0.01  # [m] below the top, above which there is none
_REACHES = (4, 2, 1)  # sections on both sides with which one is compared: far ones detect, near ones localise
_WAIST = 0.0012  # [m] by which a waist is within the chord of the outline, at least
_DROP = (0.006, 0.12)  # by which a rim is wider than what stands in it: in metres, and in its radii
_APART = 0.012  # [m] between two seams
_RIM = 0.006  # [m] height of a rim, over which nothing of it is
_BESIDE = 0.004  # [m] around the object inside a rim, in which points are its own
_OPENING = 0.97  # part of a rim's radius that is its opening
MOST = 3  # seams of one stack


@dataclass(frozen=True)
class Outline:
    """Circles about the horizontal sections of an object.

    Attributes:
        height: (n,) middles of the sections above the plane, in metres.
        centre: (n, 2) centres in the coordinates of the plane, in metres.
        radius: (n,) radii, in metres.
    """

    height: Float[np.ndarray, "n"]
    centre: Float[np.ndarray, "n 2"]
    radius: Float[np.ndarray, "n"]

    @staticmethod
    def of(plan: Float[np.ndarray, "n 2"], height: Float[np.ndarray, "n"]) -> Outline:
        """Return the outline of a cloud, interpolated where its sections show too little.

        Args:
            plan: Coordinates in the plane, in metres.
            height: Heights above the plane, in metres.
        """
        order = np.argsort(height)
        count = int(max(height.max(initial=0.0), 0.0) / SLICE)
        ends = np.searchsorted(height[order], SLICE * np.arange(count + 1))
        rows = []
        for k in range(count):
            found = _section(plan[order[ends[k] : ends[k + 1]]])
            if found is not None:
                rows.append((SLICE * (k + 0.5), *found))
        if len(rows) < 2:
            return Outline(np.zeros(0), np.zeros((0, 2)), np.zeros(0))
        known = np.array(rows)
        at = SLICE * (np.arange(round(known[0, 0] / SLICE - 0.5), count) + 0.5)
        x, y, radius = (np.interp(at, known[:, 0], column) for column in known[:, 1:].T)
        return Outline(at, np.stack([x, y], axis=1), radius)


@dataclass(frozen=True)
class Seam:
    """Where an object stands on, or in, another one.

    Attributes:
        height: Height of the seam, or of the rim around the upper object, above the plane, in metres.
        nested: Whether the upper object stands inside the rim of the lower one.
        below, above: Centre (x, y) in the plane and radius of the section below and above, in metres.
        strength: How far the outline is from one without a seam, in metres.
    """

    height: float
    nested: bool
    below: tuple[float, float, float]
    above: tuple[float, float, float]
    strength: float

    def is_above(
        self,
        plan: Float[np.ndarray, "n 2"],
        height: Float[np.ndarray, "n"],
        eye: Float[np.ndarray, "2"],
        eye_height: float,
    ) -> Bool[np.ndarray, "n"]:
        """Return which measured points of a view are of the upper object.

        Args:
            plan: Coordinates in the plane, in metres.
            height: Heights above the plane, in metres.
            eye: Position of the camera in the plane, in metres.
            eye_height: Its height above the plane, in metres.
        """
        beside = np.linalg.norm(plan - self.above[:2], axis=1) - self.above[2]
        if self.nested:
            opening, own = self.below, beside < _BESIDE
            higher = height > self.height + np.where(beside < _RIM, 0.0, _RIM)
        else:  # the floor of a bowl on a mug is lower than the mug's rim
            opening, own = min(self.below, self.above, key=lambda circle: circle[2]), height <= self.height
            higher = height > self.height
        if eye_height <= self.height:
            return higher
        share = (eye_height - self.height) / np.maximum(eye_height - height, 1e-6)
        crossing = eye + (plan - eye) * share[:, None]
        through = np.linalg.norm(crossing - opening[:2], axis=1) < _OPENING * opening[2]
        return higher | (through & own)


def find_seams(observations: Sequence[ObjectObservation], plane: SupportPlane) -> list[Seam]:
    """Return possible seams of an object over its support, the strongest first."""
    points = measured_points(observations, erode=2)
    return seams_of(Outline.of(points @ plane_basis(plane)[:2].T, plane.height_above(points)))


def seams_of(outline: Outline) -> list[Seam]:
    """Return possible seams of an outline, the strongest first."""
    r = median_filter(outline.radius, 3, mode="nearest")
    found = []
    for k in range(_LOWEST, len(r) - round(_HIGHEST / SLICE)):
        before, after = r[max(k - 3, 0) : k], r[k + 1 : k + 5]
        drop = float(np.median(before) - np.median(after))
        waists = [(r[k - reach] + r[min(k + reach, len(r) - 1)]) / 2 - r[k] for reach in _REACHES]
        if drop > max(_DROP[0], _DROP[1] * float(np.median(before))):
            found.append(_seam(outline, k, True, drop))
        elif waists[0] > _WAIST:
            found.append(_seam(outline, k, False, float(sum(waists))))
    strongest: list[Seam] = []
    for seam in sorted(found, key=lambda seam: -seam.strength):
        if all(abs(seam.height - other.height) > _APART for other in strongest):
            strongest.append(seam)
    return strongest[:MOST]


def part_masks(
    seen: ObjectObservation, seam: Seam, plane: SupportPlane
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the masks of the lower and of the upper object in a view of both, without unmeasured pixels."""
    basis = plane_basis(plane)
    v, u = np.nonzero(seen.mask & (seen.frame.depth > 0))
    depth = seen.frame.depth[v, u][:, None].astype(np.float64)
    points = transform_points(seen.T_world_camera, pixel_rays(seen.frame, u, v) * depth)
    eye = seen.T_world_camera[:3, 3]
    above = seam.is_above(
        points @ basis[:2].T,
        plane.height_above(points),
        basis[:2] @ eye,
        float(plane.height_above(eye[None])[0]),
    )
    masks = np.zeros((2, *seen.mask.shape), bool)
    masks[above.astype(int), v, u] = True
    return masks[0], masks[1]


def _section(points: Float[np.ndarray, "n 2"]) -> tuple[float, float, float] | None:
    """Return centre and radius of the circle about the points of a section; None if it shows too little."""
    if len(points) < _MIN_POINTS:
        return None
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    centre, radius = (low + high) / 2, 0.0
    for _ in range(2):
        edge = outermost(points, centre)
        if len(edge) < _MIN_SECTORS:
            return None
        centre, radius = circle(edge)
        if not radius < 0.3:
            return None
    return float(centre[0]), float(centre[1]), radius


def _seam(outline: Outline, k: int, nested: bool, strength: float) -> Seam:
    """Return the seam at section k with the circles a little below and above it."""
    below, above = max(k - 1, 0), min(k + 2, len(outline.height) - 1)
    circles = [(*outline.centre[i].tolist(), float(outline.radius[i])) for i in (below, above)]
    return Seam(float(outline.height[k]), nested, circles[0], circles[1], strength)
