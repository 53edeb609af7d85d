"""Follows the objects: the scene of planning is set to what is seen."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.observation import Finding, SceneObserver, is_displaced
from manipulation.planning_scene import PlanningScene

BESIDE = 0.15  # [m] between the axes of a moved object and of those that it may have pushed


@dataclass(frozen=True)
class Searched:
    """Result of a search for an object.

    Attributes:
        problem: why the object cannot be handled; empty if it can.
        is_in_place: whether it was found where it was expected.
    """

    problem: str = ""
    is_in_place: bool = False


class SceneFollowing:
    """Looks for objects and sets them, and the things of no class, to where they are.

    Args:
        scene: the scene of planning, which is updated.
        observer: looks at the scene.
    """

    def __init__(self, scene: PlanningScene, observer: SceneObserver) -> None:
        self._scene, self._observer = scene, observer

    def find(self, name: str) -> Finding:
        """Search for an object; update its pose and the things of no class as far as they were seen."""
        finding = self._observer.find(name, self._scene.poses())
        if finding.obstacles is not None:
            self._scene.observe_obstacles(finding.obstacles)
        if finding.T_world_stand is not None:
            self._scene.moved(name, finding.T_world_stand)
        return finding

    def search(self, name: str) -> Searched:
        """Search for an object where it was, and then on the table."""
        before = self._scene.poses().get(name)
        finding = self.find(name)
        if finding.status == "missing":
            self._scene.forget(name)
            return Searched(f"{name} is nowhere on the table within view: it was taken away or fell off")
        T = finding.T_world_stand
        if T is None and name in self._scene.forgotten:
            return Searched(f"{name} is nowhere within view, as before")
        return Searched(is_in_place=T is not None and before is not None and not is_displaced(before, T))

    def renew_obstacles(self) -> None:
        """Look for the things of no class anew, beside the objects as they are."""
        obstacles = self._observer.find_obstacles(self._scene.poses())
        if obstacles is not None:
            self._scene.observe_obstacles(obstacles)

    def displaced_near(
        self, T_world_stand: Float[np.ndarray, "4 4"], but: Collection[str]
    ) -> Iterator[tuple[str, Float[np.ndarray, "4 4"]]]:
        """Yield the objects near a pose that are not where they were, once found, with their old poses.

        Args:
            T_world_stand: pose of an object that was moved.
            but: names of the objects that are not looked at.
        """
        poses = self._scene.poses()
        beside = tuple(
            name
            for name, T in poses.items()
            if name not in but and np.linalg.norm((T - T_world_stand)[:2, 3]) < BESIDE
        )
        for name, presence in self._observer.glance(poses, beside).items() if beside else ():
            if presence == "displaced" and self.find(name).T_world_stand is not None:
                yield name, poses[name]
