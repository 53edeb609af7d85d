"""Solid space of one thing: voxels that were measured, and hidden ones next to them, without free space.

A voxel is measured if enough points lie in it, and free if a view sees through it (space carving; Kutulakos
and Seitz, "A theory of shape by space carving", IJCV 2000). Hidden voxels are neither: they count as solid
close to measured ones, because a thing that is seen from one side goes on behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from perception.detection.geometry import height_image, in_image, project
from perception.support.samples import depth_noise
from perception.types import RgbdFrame, SupportPlane

_UNMEASURED = np.float32(1e6)  # [m]: such a neighbour limits nothing
_LOWEST = 0.01  # [m] height from which a measurement cannot be one of the support
_NOISE_FACTOR = 4.0  # the same in standard deviations of the depth; the larger of both counts


def lowest_height(depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the height above the support in [m] below which points of this depth [m] may be the support."""
    return np.maximum(_LOWEST, _NOISE_FACTOR * depth_noise(depth))


@dataclass(frozen=True)
class VolumeConfig:
    """Parameters of the volume; lengths in metres.

    Attributes:
        voxel: Edge length of a voxel.
        min_points: Smallest number of points, over all views, in a measured voxel.
        max_hidden: Largest distance of a solid hidden voxel from a measured one.
        footprint: Side of the window of pixels that must all lie behind a free voxel.
    """

    voxel: float = 0.005
    min_points: int = 3
    max_hidden: float = 0.04
    footprint: int = 3


@dataclass(frozen=True)
class Solid:
    """Space of a thing in the frame of the support plane, in metres.

    Attributes:
        points: (n, 3) mean of the points in each measured voxel, and centres of the solid hidden voxels that
            are not enclosed by others.
        free: (m, 3) centres of the voxels around it that were seen to be free.
    """

    points: Float[np.ndarray, "n 3"]
    free: Float[np.ndarray, "m 3"]


def solid_of(
    points_plane: Float[np.ndarray, "n 3"],
    frames: Sequence[RgbdFrame],
    T_world_plane: Float[np.ndarray, "4 4"],
    config: VolumeConfig = VolumeConfig(),
) -> Solid:
    """Return the solid space around measured points; empty if no voxel holds enough of them.

    Args:
        points_plane: Points of one thing in a frame whose plane z = 0 is the support.
        frames: Views without flying pixels, with poses.
        T_world_plane: Pose of that frame.
        config: Parameters.
    """
    grid = _Grid.around(points_plane, config)
    cells = grid.cells(points_plane)
    count = np.bincount(cells, minlength=grid.size)
    at_surface, through = _votes(grid, frames, T_world_plane, config)
    measured = (count >= config.min_points) & (at_surface >= through)
    hidden = ~measured & (through == 0)
    steps = round(config.max_hidden / config.voxel)
    shape = grid.shape
    solid = measured.reshape(shape)
    solid = ndimage.binary_dilation(solid, iterations=steps, mask=(measured | hidden).reshape(shape))
    shell = (solid & np.logical_not(ndimage.binary_erosion(solid))).ravel()
    means = np.stack([np.bincount(cells, p, grid.size) for p in points_plane.T], axis=1)
    means = means[measured] / count[measured, None]
    return Solid(np.concatenate([means, grid.centres[shell & ~measured]]), grid.centres[through > 0])


@dataclass(frozen=True)
class _Grid:
    low: Float[np.ndarray, "3"]
    shape: tuple[int, int, int]
    voxel: float

    @staticmethod
    def around(points: Float[np.ndarray, "n 3"], config: VolumeConfig) -> _Grid:
        """Return the grid around points and what may be hidden behind them, from the support to their top."""
        margin = np.array([1.0, 1.0, 0.0]) * (config.max_hidden + config.voxel)
        low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
        low[2] = 0.0
        nx, ny, nz = (int(n) for n in np.ceil((high - low) / config.voxel) + 1)
        return _Grid(low, (nx, ny, nz), config.voxel)

    @property
    def size(self) -> int:
        return int(np.prod(self.shape))

    def cells(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
        """Return the flat index of the voxel of each point."""
        index = ((points - self.low) / self.voxel).astype(np.int64)
        return np.asarray(np.ravel_multi_index(tuple(index.T), self.shape))

    @property
    def centres(self) -> Float[np.ndarray, "k 3"]:
        axes = [self.low[k] + self.voxel * (np.arange(n) + 0.5) for k, n in enumerate(self.shape)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _votes(
    grid: _Grid,
    frames: Sequence[RgbdFrame],
    T_world_plane: Float[np.ndarray, "4 4"],
    config: VolumeConfig,
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Return in how many views each voxel is at a measured surface, and how many see through it."""
    centres = grid.centres @ T_world_plane[:3, :3].T + T_world_plane[:3, 3]
    at_surface, through = np.zeros((2, grid.size), dtype=np.int64)
    normal = T_world_plane[:3, 2]
    plane = SupportPlane(normal, float(normal @ T_world_plane[:3, 3]))
    for frame in frames:
        pixels, depth = project(frame, centres)
        inside = in_image(frame, pixels, depth)
        u, v = np.where(inside[:, None], pixels, 0).T
        seen = frame.depth[v, u]
        tolerance = 0.5 * config.voxel + depth_noise(seen)
        inside &= seen > 0
        at_surface += inside & (np.abs(seen - depth) <= 2 * tolerance)
        # Voxels within the tolerance of the support itself are free where the support is seen.
        beyond = np.where(_shows_support(frame, plane, config.footprint)[v, u], tolerance, -tolerance)
        through += inside & (depth < _nearest(frame.depth, config.footprint)[v, u] + beyond)
    return at_surface, through


def _nearest(depth: Float[np.ndarray, "h w"], footprint: int) -> Float[np.ndarray, "h w"]:
    """Return the smallest measured depth in the window around each pixel, in metres."""
    known = np.where(depth > 0, depth, _UNMEASURED).astype(np.float32)
    return np.asarray(cv2.erode(known, np.ones((footprint, footprint), np.uint8)))


def _shows_support(frame: RgbdFrame, plane: SupportPlane, footprint: int) -> Bool[np.ndarray, "h w"]:
    """Return the pixels in whose window nothing rises above the support."""
    low = height_image(frame, plane) < lowest_height(frame.depth)
    return np.asarray(cv2.erode(low.astype(np.uint8), np.ones((footprint, footprint), np.uint8))) > 0
