"""Objects as people leave them: lying, upside down, stacked; every resting pose is found by physics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations, product
from typing import cast

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from perception.types import Category
from sim_assets.cell.layout import ArrangementError, UnstableError
from sim_assets.cell.resting import Settled, settle, tilt
from sim_assets.cell.settling import FALLEN_TILT
from sim_assets.cell.unknown import UnknownThing
from sim_assets.objects import ObjectModel

LYING_TILT = (np.deg2rad(60), np.deg2rad(120))
UPSIDE_DOWN_TILT = np.deg2rad(165)
STACKED_TILT = np.deg2rad(25)  # largest tilt of an object that stands on or in another one
# By which a thing of no class is tilted about both horizontal axes, and by how much its vertical differs then
# if it fell. What balances on an edge falls by less than what stands on its tip; what rolls stays as turned.
TILTED = ((np.deg2rad(6), FALLEN_TILT), (np.deg2rad(2), np.deg2rad(4)))
_SIDES = tuple(
    np.array(side) for side in ((1.0, 1.0, 0.0), (-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (-1.0, 1.0, 0.0))
)
MOST_FALLS = 4  # after which a thing is left as it lies: what is round rolls each time
SUPPORTED = 0.005  # [m], smallest height of its base above the table
MOST_STEPS = 3000  # candidates that a search examines before the counts are refused
_LYING: tuple[Category, ...] = ("bottle", "can", "mug")
_UPSIDE_DOWN: tuple[Category, ...] = ("mug", "bowl", "can")
STACKS: tuple[tuple[Category, Category], ...] = (  # (above, below)
    ("bowl", "bowl"), ("can", "can"), ("mug", "bowl"), ("can", "bowl"), ("bowl", "can"), ("bowl", "mug"),
    ("mug", "can"),
)  # fmt: skip
_Members = dict[int, Float[np.ndarray, "4 4"]]  # T_group_object by index
_WIDEST = {"bowl": 1.0, "can": 3.0, "mug": 3.0}  # radius of the object above, as a multiple of that below


@dataclass(frozen=True)
class Arrangement:
    """Number of objects in each resting pose; all others stand upright on the table.

    Attributes:
        lying: objects that lie on their side: bottles, cans and mugs.
        upside_down: mugs, bowls and cans that stand on their rim.
        stacked: objects that stand on or in another one.
        at_most: whether fewer are accepted where the objects do not rest that way.
    """

    lying: int = 0
    upside_down: int = 0
    stacked: int = 0
    at_most: bool = False


@dataclass(frozen=True)
class Group:
    """Objects that are placed on the table as one: a single one, or a stack.

    Attributes:
        Ts_group_object: T_group_object by index of the object; None for an upright one in its own frame.
        mesh: surfaces of all of them in the frame of the group, whose z = 0 is the table [m].
    """

    Ts_group_object: dict[int, Float[np.ndarray, "4 4"] | None]
    mesh: trimesh.Trimesh


def arrange(
    models: Sequence[ObjectModel],
    arrangement: Arrangement,
    rng: np.random.Generator,
    span: float = math.inf,
) -> list[Group]:
    """Choose at random which objects lie, stand on their rim or on others, and find their resting poses.

    Args:
        models: the objects.
        arrangement: number of objects in each resting pose.
        rng: source of random numbers.
        span: diameter [m] up to which objects are preferred that stand on their rim: a hand turns them over
            by their body.

    Raises:
        ArrangementError: too few of the objects rest that way; the message gives the option and the number.
    """
    finder = _Finder(models, rng)
    while True:
        try:
            return _Assignment(finder, arrangement, rng, span).groups()
        except ArrangementError as error:
            if not arrangement.at_most:
                raise
            arrangement = replace(arrangement, **{error.pose: getattr(arrangement, error.pose) - 1})


def rest_unknown(thing: UnknownThing, name: str) -> Group:
    """Return a thing of no class at rest, as the only member of its group, with index 0.

    What falls when it is tilted a little, as an egg on its tip, rests as it lies then; what falls again and
    again, as something round, is left as it lies in the end. The surface of the group is that of the
    collision pieces, so that neighbours never start inside them.

    Args:
        thing: The thing.
        name: Name of its body.

    Raises:
        UnstableError: it does not come to rest.
    """
    settled = settle([(thing, _raised(np.eye(4), 0.001))])
    for _ in range(MOST_FALLS):
        fallen = _fallen_when_tilted(thing, settled.poses[0]) if settled.at_rest else None
        if fallen is None:
            break
        settled = fallen
    if not settled.at_rest:
        raise UnstableError(f"the thing of no class {name} does not come to rest", name)
    return _group({0: settled.poses[0]}, {0: thing.hulls})


def _fallen_when_tilted(thing: UnknownThing, T_world_thing: Float[np.ndarray, "4 4"]) -> Settled | None:
    """Return where a thing comes to rest after a slight tilt to any side; None if that is as before."""
    corners = np.asarray(thing.hulls.vertices)
    for (angle, fallen), side in product(TILTED, _SIDES):
        T = T_world_thing.copy()
        T[:3, :3] = Rotation.from_rotvec(angle * side).as_matrix() @ T[:3, :3]
        lowest = float((corners @ T[2, :3]).min())
        T[2, 3] = 0.001 - lowest
        settled = settle([(thing, T)])
        if np.arccos(np.clip(settled.poses[0][2, :3] @ T_world_thing[2, :3], -1.0, 1.0)) > fallen:
            return settled
    return None


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
        if (top.category, base.category) not in STACKS or top.radius > _WIDEST[base.category] * base.radius:
            return None
        start = _raised(np.eye(4), base.height + 0.002)
        settled = settle([(base, _raised(np.eye(4), 0.001)), (top, start)])
        T_base, T_top = settled.poses
        T = np.linalg.inv(T_base) @ T_top
        stands = settled.at_rest and tilt(T_base) < np.deg2rad(3) and tilt(T_top) < STACKED_TILT
        centred = np.hypot(T[0, 3], T[1, 3]) < base.radius
        return T if stands and centred and T[2, 3] > SUPPORTED else None


class _Assignment:
    """Search with backtracking for disjoint objects, or pairs of them, that rest in the poses asked for."""

    def __init__(
        self, finder: _Finder, arrangement: Arrangement, rng: np.random.Generator, span: float
    ) -> None:
        self._finder = finder
        # the scarcest first: vessels with a rim, then pairs that stand, then what can lie
        order = ("upside_down", "stacked", "lying")
        self._wanted = [pose for pose in order for _ in range(getattr(arrangement, pose))]
        everyone = [int(i) for i in rng.permutation(len(finder.models))]
        by_span = sorted(everyone, key=lambda i: 2 * finder.models[i].radius > span)
        self._candidates: dict[str, list[tuple[int, ...]]] = {
            "upside_down": [(i,) for i in by_span],
            "stacked": list(permutations(everyone, 2)),
            "lying": [(i,) for i in everyone],
        }
        self._steps = 0
        self._most: list[tuple[str, _Members]] = []  # the longest partial assignment

    def groups(self) -> list[Group]:
        """Return all objects in groups; those of no other pose stand upright."""
        if not self._search([], 0):
            pose = self._wanted[len(self._most)]
            found = sum(pose == other for other, _ in self._most)
            raise ArrangementError(pose, self._wanted.count(pose), found)
        models = self._finder.models
        groups = [_group(members, {i: models[i].mesh for i in members}) for _, members in self._most]
        taken = {i for _, members in self._most for i in members}
        groups += [Group({i: None}, model.mesh) for i, model in enumerate(models) if i not in taken]
        return sorted(groups, key=lambda group: min(group.Ts_group_object))

    def _search(self, chosen: list[tuple[str, _Members]], start: int) -> bool:
        """Extend a partial assignment to a complete one; return whether there is one within MOST_STEPS.

        Of the candidates for the next pose, those before ``start`` have been tried.
        """
        if len(chosen) > len(self._most):
            self._most = list(chosen)
        if len(chosen) == len(self._wanted):
            return True
        pose = self._wanted[len(chosen)]
        taken = {i for _, members in chosen for i in members}
        candidates = self._candidates[pose]
        for index in range(start, len(candidates)):
            if not taken.isdisjoint(candidates[index]):
                continue
            members = self._resting(pose, candidates[index])
            self._steps += 1
            if self._steps > MOST_STEPS:
                return False
            if members is None:
                continue
            following = self._wanted[len(chosen) + 1 : len(chosen) + 2]
            if self._search([*chosen, (pose, members)], index + 1 if following == [pose] else 0):
                return True
        return False

    def _resting(self, pose: str, indices: tuple[int, ...]) -> _Members | None:
        """Return the poses of one object, or of a pair, at rest in a pose; None if they do not rest there."""
        if pose == "stacked":
            above, below = indices
            T = self._finder.stack(above, below)
            return None if T is None else {below: np.eye(4), above: T}
        (index,) = indices
        T = self._finder.lying(index) if pose == "lying" else self._finder.upside_down(index)
        return None if T is None else {index: T}


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
