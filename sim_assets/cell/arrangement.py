"""Objects as people leave them: lying, upside down, stacked; every resting pose is found by physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice, permutations
from typing import cast

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from perception.types import Category
from sim_assets.cell.layout import LayoutError
from sim_assets.cell.resting import settle, tilt
from sim_assets.cell.unknown import UnknownThing
from sim_assets.objects import ObjectModel

LYING_TILT = (np.deg2rad(60), np.deg2rad(120))
UPSIDE_DOWN_TILT = np.deg2rad(165)
STACKED_TILT = np.deg2rad(25)  # largest tilt of an object that stands on or in another one
SUPPORTED = 0.005  # [m], smallest height of its base above the table
ASSIGNMENTS = 8  # random choices of which objects lie, stand on others, ... before the counts are refused
_LYING: tuple[Category, ...] = ("bottle", "can", "mug")
_UPSIDE_DOWN: tuple[Category, ...] = ("mug", "bowl", "can")
_STACKS: tuple[tuple[Category, Category], ...] = (  # (above, below)
    ("bowl", "bowl"), ("can", "can"), ("mug", "bowl"), ("can", "bowl"), ("bowl", "can"), ("bowl", "mug"),
    ("mug", "can"),
)  # fmt: skip
_WIDEST = {"bowl": 1.0, "can": 3.0, "mug": 3.0}  # radius of the object above, as a multiple of that below


@dataclass(frozen=True)
class Arrangement:
    """Number of objects in each resting pose; all others stand upright on the table.

    Attributes:
        lying: objects that lie on their side: bottles, cans and mugs.
        upside_down: mugs, bowls and cans that stand on their rim.
        stacked: objects that stand on or in another one.
    """

    lying: int = 0
    upside_down: int = 0
    stacked: int = 0


@dataclass(frozen=True)
class Group:
    """Objects that are placed on the table as one: a single one, or a stack.

    Attributes:
        Ts_group_object: T_group_object by index of the object; None for an upright one in its own frame.
        mesh: surfaces of all of them in the frame of the group, whose z = 0 is the table [m].
    """

    Ts_group_object: dict[int, Float[np.ndarray, "4 4"] | None]
    mesh: trimesh.Trimesh


def arrange(models: Sequence[ObjectModel], arrangement: Arrangement, rng: np.random.Generator) -> list[Group]:
    """Choose which objects lie, stand on their rim or on others, and find their resting poses.

    Raises:
        LayoutError: too few of the objects rest that way; the message gives the option and the number.
    """
    finder = _Finder(models, rng)
    error = LayoutError("")
    for _ in range(ASSIGNMENTS):
        try:
            return _assign(finder, arrangement, rng)
        except LayoutError as failed:
            error = failed
    raise error


def rest_unknown(thing: UnknownThing) -> Group:
    """Return a thing of no class at rest, as the only member of its group, with index 0.

    The surface of the group is that of the collision pieces, so that neighbours never start inside them.

    Raises:
        LayoutError: it does not come to rest.
    """
    settled = settle([(thing, _raised(np.eye(4), 0.001))])
    if not settled.at_rest:
        raise LayoutError("a thing of no class does not come to rest")
    return _group({0: settled.poses[0]}, {0: thing.hulls})


class _Finder:
    """Resting poses of the objects of a scene, each simulated once."""

    def __init__(self, models: Sequence[ObjectModel], rng: np.random.Generator) -> None:
        self.models = models
        self._roll = rng.uniform(-np.pi, np.pi, len(models))
        self.lying = cache(self._lying)
        self.upside_down = cache(self._upside_down)
        self.stack = cache(self._stack)

    def _lying(self, index: int) -> Float[np.ndarray, "4 4"] | None:
        """Return T_world_object of an object at rest on its side; None if it does not rest there."""
        if self.models[index].category not in _LYING:
            return None
        T = self._rest(index, Rotation.from_euler("zy", (self._roll[index], np.pi / 2)).as_matrix())
        return T if T is not None and LYING_TILT[0] < tilt(T) < LYING_TILT[1] else None

    def _upside_down(self, index: int) -> Float[np.ndarray, "4 4"] | None:
        """Return T_world_object of an object at rest on its rim; None if it does not rest there."""
        if self.models[index].category not in _UPSIDE_DOWN:
            return None
        T = self._rest(index, np.diag([1.0, -1.0, -1.0]))
        return T if T is not None and tilt(T) > UPSIDE_DOWN_TILT else None

    def _rest(self, index: int, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"] | None:
        model, T = self.models[index], np.eye(4)
        T[:3, :3] = rotation
        lowest = float((model.mesh.vertices @ rotation.T)[:, 2].min())
        settled = settle([(model, _raised(T, 0.001 - lowest))])
        return settled.poses[0] if settled.at_rest else None

    def _stack(self, above: int, below: int) -> Float[np.ndarray, "4 4"] | None:
        """Return T_below_above at rest on or in the object below; None if the stack does not stand."""
        top, base = self.models[above], self.models[below]
        if (top.category, base.category) not in _STACKS or top.radius > _WIDEST[base.category] * base.radius:
            return None
        start = _raised(np.eye(4), base.height + 0.002)
        settled = settle([(base, _raised(np.eye(4), 0.001)), (top, start)])
        T_base, T_top = settled.poses
        T = np.linalg.inv(T_base) @ T_top
        stands = settled.at_rest and tilt(T_base) < np.deg2rad(3) and tilt(T_top) < STACKED_TILT
        centred = np.hypot(T[0, 3], T[1, 3]) < base.radius
        return T if stands and centred and T[2, 3] > SUPPORTED else None


def _assign(finder: _Finder, arrangement: Arrangement, rng: np.random.Generator) -> list[Group]:
    """Return the groups of one random assignment of the resting poses."""
    models = finder.models
    free = [int(i) for i in rng.permutation(len(models))]
    groups: list[Group] = []
    kinds = (
        ("--lying", arrangement.lying, finder.lying),
        ("--upside-down", arrangement.upside_down, finder.upside_down),
    )
    for option, count, rest in kinds:
        found = dict(islice(((i, T) for i in free if (T := rest(i)) is not None), count))
        if len(found) < count:
            raise _too_few(option, count, len(found), "rest that way")
        groups += [_group({i: T}, {i: models[i].mesh}) for i, T in found.items()]
        free = [i for i in free if i not in found]
    for n_found in range(arrangement.stacked):
        pairs = permutations(free, 2)
        found = next(((*pair, T) for pair in pairs if (T := finder.stack(*pair)) is not None), None)
        if found is None:
            raise _too_few("--stacked", arrangement.stacked, n_found, "stand on others")
        above, below, T = found
        members = {below: np.eye(4), above: T}
        groups.append(_group(members, {i: models[i].mesh for i in members}))
        free = [i for i in free if i not in members]
    groups += [Group({i: None}, models[i].mesh) for i in free]
    return sorted(groups, key=lambda group: min(group.Ts_group_object))


def _too_few(option: str, wanted: int, found: int, what: str) -> LayoutError:
    return LayoutError(f"{option} {wanted}: only {found} of these objects {what}; use other or more objects")


def _group(poses: dict[int, Float[np.ndarray, "4 4"]], meshes: dict[int, trimesh.Trimesh]) -> Group:
    """Return a group with its outline's bounding box centred on the origin."""
    surfaces = []
    for index, T in poses.items():
        surface = trimesh.Trimesh(meshes[index].vertices, meshes[index].faces, process=False)
        surfaces.append(surface.apply_transform(T))
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(surfaces))
    shift = np.eye(4)
    shift[:2, 3] = -mesh.bounds[:, :2].mean(axis=0)
    mesh.apply_transform(shift)
    return Group({index: shift @ T for index, T in poses.items()}, mesh)


def _raised(T: Float[np.ndarray, "4 4"], height: float) -> Float[np.ndarray, "4 4"]:
    raised = T.copy()
    raised[2, 3] += height
    return raised
