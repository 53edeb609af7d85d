"""Objects that stand on or in others, in scenes without physics: the upper one sinks until both touch.

Reliefs stand in for solids: the upper side of the lower object is sampled on a grid, and the upper object
comes down vertically until one of its points meets it. What fills a vessel is not in its way.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from perception.geometry import rigid
from perception.types import Category
from sim_assets.cell import arrangement
from sim_assets.datasets.scatter import TableItem

# (above, below): those of the tables of tasks, and more.
STACKS: tuple[tuple[Category, Category], ...] = (
    *arrangement.STACKS, ("mug", "mug"), ("can", "mug"), ("bottle", "bowl"),
)  # fmt: skip
MOST = 3  # stacks in an image
_CELL = 0.002  # of a relief [m]
_POINTS = 20000  # samples of a surface, a few in each cell of a relief
_FEW = 4000  # of them, where an object comes down
_EMPTY = -1.0  # height where a relief has no surface [m]
_OFF_CENTRE = 0.2  # largest offset of the upper object, relative to the lower one's reach
_LEANING = 0.4  # share of the objects in bowls and mugs that lean
_MOST_LEANING = np.radians(22)
_TRIES = 8
# Largest reach of the upper object, as a multiple of the lower one's, by the class of the lower.
_WIDEST: dict[Category, float] = {"bowl": 1.05, "can": 3.0, "mug": 3.0}


class Stacks:
    """Places items of a pool on and in others."""

    def __init__(self, items: Sequence[TableItem]) -> None:
        """Prepare a pool; surfaces are sampled when first needed, the same for the same meshes."""
        self._items = items
        self._samples = cache(self._sampled)
        self._relief = cache(self._sampled_relief)

    def draw(
        self, shown: Sequence[int], poses: Sequence[Float[np.ndarray, "4 4"]], rng: np.random.Generator
    ) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Return T_world_item of one to three further items, by number, each on an item that is shown.

        Only upright objects of known class carry others or stand on them. There are fewer, or none, where
        nothing fits.

        Args:
            shown: items on the table.
            poses: T_world_item of each.
            rng: source of randomness.
        """
        added: dict[int, Float[np.ndarray, "4 4"]] = {}
        free = [k for k in range(len(self._items)) if k not in shown and self._is_upright(k)]
        carriers = [place for place, k in enumerate(shown) if self._is_upright(k)]
        wanted = int(rng.integers(1, MOST + 1))
        for place in rng.permutation(carriers):
            if len(added) == wanted:
                break
            below, T_world_below = shown[place], poses[place]
            others = [(k, T) for k, T in zip(shown, poses, strict=True) if k != below] + list(added.items())
            for above in rng.permutation(free)[:_TRIES].tolist():
                T_below_above = self.rest(above, below, rng)
                if above in added or T_below_above is None:
                    continue
                T_world_above = T_world_below @ T_below_above
                if self._is_clear(above, T_world_above, others):
                    added[above] = T_world_above
                    break
        return added

    def rest(self, above: int, below: int, rng: np.random.Generator) -> Float[np.ndarray, "4 4"] | None:
        """Return T_below_above at a random yaw, offset and tilt; None if the items make no stack."""
        upper, lower = self._items[above], self._items[below]
        if upper.category is None or lower.category is None:
            return None
        if (upper.category, lower.category) not in STACKS:
            return None
        if upper.reach > _WIDEST[lower.category] * lower.reach:
            return None
        tilt = 0.0
        if lower.category in ("bowl", "mug") and rng.random() < _LEANING:
            tilt = rng.uniform(0, _MOST_LEANING)
        about = rng.uniform(-np.pi, np.pi)
        R = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0])) * Rotation.from_euler(
            "z", rng.uniform(-np.pi, np.pi)
        )
        offset = np.append(_OFF_CENTRE * lower.reach * rng.uniform(-1, 1, 2), 0.0)
        points = R.apply(self._samples(above)[:_FEW]) + offset
        height = sink(points, self._relief(below))
        if height is None or height < arrangement.SUPPORTED or height + points[:, 2].min() < 0:
            return None
        return rigid(R.as_matrix(), offset + np.array([0.0, 0.0, height]))

    def _is_upright(self, item: int) -> bool:
        return self._items[item].category is not None and not self._items[item].ignored

    def _is_clear(
        self,
        above: int,
        T_world_above: Float[np.ndarray, "4 4"],
        others: Sequence[tuple[int, Float[np.ndarray, "4 4"]]],
    ) -> bool:
        """Return whether none of the others reaches up to the item beside it; circles stand for outlines."""
        for item, pose in others:
            distance = np.hypot(*(pose[:2, 3] - T_world_above[:2, 3]))
            near = distance < self._items[item].reach + self._items[above].reach
            if near and pose[2, 3] + self._items[item].mesh.bounds[1, 2] > T_world_above[2, 3]:
                return False
        return True

    def _sampled(self, item: int) -> Float[np.ndarray, "n 3"]:
        return np.asarray(trimesh.sample.sample_surface(self._items[item].mesh, _POINTS, seed=0)[0])

    def _sampled_relief(self, item: int) -> Float[np.ndarray, "k k"]:
        return relief(self._samples(item))


def relief(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k k"]:
    """Return the greatest height in each cell of a square grid about the z axis, -1 where there is none.

    Gaps between samples are closed: a cell has the greatest height of its neighbourhood of 3 x 3.

    Args:
        points: dense samples of a surface [m].
    """
    half = int(np.ceil(np.abs(points[:, :2]).max() / _CELL)) + 2
    heights = np.full((2 * half, 2 * half), _EMPTY, np.float32)
    cells = np.floor(points[:, :2] / _CELL).astype(int) + half
    np.maximum.at(heights, (cells[:, 0], cells[:, 1]), points[:, 2].astype(np.float32))
    return cv2.dilate(heights, np.ones((3, 3), np.uint8)).astype(np.float64)


def sink(points: Float[np.ndarray, "n 3"], ground: Float[np.ndarray, "k k"]) -> float | None:
    """Return the height at which points come to rest that sink onto a ``relief``; None if they miss it."""
    half = len(ground) // 2
    cells = np.floor(points[:, :2] / _CELL).astype(int) + half
    over = ((cells >= 0) & (cells < len(ground))).all(axis=1)
    heights = ground[cells[over, 0], cells[over, 1]]
    hit = heights > _EMPTY
    return float((heights - points[over, 2])[hit].max()) if hit.any() else None
