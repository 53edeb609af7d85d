"""The scene as planning knows it: objects, obstacles, and the grasps that they leave free.

It follows what is moved and what is seen, and for a while it can be as if an object were absent or elsewhere.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from manipulation.collision import Body, CollisionConfig, CollisionWorld
from manipulation.grasp_config import GraspConfig
from manipulation.hulls import convex_pieces
from manipulation.known_grasps import KnownGrasps
from manipulation.lying_grasps import lies
from manipulation.obstacles import Obstacle
from manipulation.robot import ArmDescription
from manipulation.surroundings import Surfaces, points_around
from manipulation.types import GraspSet, StandingObject
from manipulation.vessels import holds, vessel_pieces
from perception.obstacles.obstacle import PerceivedObstacle


class SceneState:
    """A state of the scene, equal to itself alone. What failed in it fails again.

    A ``WeakKeyDictionary`` of what is known of states drops what no scene can return to.
    """


class PlanningScene:
    """Objects of known and unknown pose, and obstacles, in a collision world.

    Args:
        arm: the arm.
        items: all objects by name.
        obstacles: static obstacles, of known geometry or perceived.
        collision, grasp: settings of the collision world and of grasp generation.
        grasps: known grasp candidates by name; those that are missing are generated.

    Attributes:
        items: all objects by name, as they were in the beginning.
        world: the collision world; a new one once obstacles are replaced.
        state: present state of the scene.
    """

    def __init__(
        self,
        arm: ArmDescription,
        items: Mapping[str, StandingObject],
        obstacles: Sequence[Obstacle | PerceivedObstacle],
        collision: CollisionConfig,
        grasp: GraspConfig,
        grasps: Mapping[str, GraspSet] | None = None,
    ) -> None:
        self._arm, self._collision, self._grasp = arm, collision, grasp
        self.items = dict(items)
        self._obstacles = tuple(obstacles)
        self._known = KnownGrasps(self.items, grasp, self._points_around, grasps)
        self._surfaces = Surfaces()
        self._forgotten: set[str] = set()
        self.state = SceneState()
        self.world = self._build_world({name: item.T_world_stand for name, item in self.items.items()})

    def _build_world(self, poses: Mapping[str, Float[np.ndarray, "4 4"]]) -> CollisionWorld:
        """Return the collision world with the objects at ``poses``, their T_world_stand."""
        bodies = [Body(name, self._pieces(name, poses), T) for name, T in poses.items()]
        return CollisionWorld(self._arm, bodies, self._obstacles, self._collision)

    def _pieces(
        self, name: str, poses: Mapping[str, Float[np.ndarray, "4 4"]]
    ) -> tuple[Float[np.ndarray, "_k 3"], ...]:
        """Return the convex pieces of an object: of a vessel that holds another one, with its cavity free."""
        item = self.items[name]
        others = [(self.items[n], T) for n, T in poses.items() if n != name and n not in self._forgotten]
        if holds(item, poses[name], others):
            return vessel_pieces(item, self._grasp)
        return convex_pieces(item)

    @property
    def forgotten(self) -> frozenset[str]:
        """Names of the objects of unknown pose."""
        return frozenset(self._forgotten)

    @property
    def obstacles(self) -> tuple[Obstacle | PerceivedObstacle, ...]:
        """The static obstacles, of known geometry or perceived."""
        return self._obstacles

    @property
    def perceived_obstacles(self) -> tuple[PerceivedObstacle, ...]:
        """The obstacles of perceived geometry."""
        return tuple(o for o in self._obstacles if isinstance(o, PerceivedObstacle))

    def pose(self, name: str) -> Float[np.ndarray, "4 4"]:
        """Return T_world_stand of an object; of a forgotten one, where it was last."""
        return self.world.pose(name)

    def poses(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Return T_world_stand of every object that is not forgotten, by name."""
        return {name: self.world.pose(name) for name in self.world.names if name not in self._forgotten}

    def observe_obstacles(self, obstacles: Sequence[PerceivedObstacle]) -> None:
        """Replace the perceived obstacles; objects remain as they are, forgotten ones forgotten."""
        known = tuple(o for o in self._obstacles if not isinstance(o, PerceivedObstacle))
        poses = {name: self.world.pose(name) for name in self.world.names}
        self._obstacles = (*known, *obstacles)
        self.world = self._build_world(poses)
        self._on_change()
        for name in poses:
            self.world.set_present(name, name not in self._forgotten)

    def moved(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> None:
        """Set the pose of an object that was moved, in any orientation."""
        self.world.set_present(name, True)
        self.world.move(name, T_world_stand)
        self._known.on_move(name)
        self._on_change()
        self._forgotten.discard(name)

    def forget(self, name: str) -> None:
        """Remove an object of unknown pose from the collision world."""
        self.world.set_present(name, False)
        self._on_change()
        self._forgotten.add(name)

    @contextlib.contextmanager
    def without(self, names: Collection[str]) -> Iterator[None]:
        """Be as if some objects were not there; afterwards the scene is the same again."""
        absent = set(names) - self._forgotten
        if not absent:
            yield
            return
        with self._other_state():
            self._forgotten |= absent
            for name in absent:
                self.world.set_present(name, False)
            try:
                yield
            finally:
                self._forgotten -= absent
                for name in absent:
                    self.world.set_present(name, True)

    @contextlib.contextmanager
    def supposing(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> Iterator[None]:
        """Be as if an object of known pose were at another one; afterwards the scene is the same again."""
        T_now = self.world.pose(name)
        with self._other_state():
            self.world.move(name, T_world_stand)
            self._known.on_move(name)
            try:
                yield
            finally:
                self.world.move(name, T_now)
                self._known.on_move(name)

    @contextlib.contextmanager
    def _other_state(self) -> Iterator[None]:
        """Let nothing that is found in another state be used in this one, nor the other way round."""
        state = self.state
        self._on_change()
        try:
            yield
        finally:
            self._known.on_change()
            self.state = state

    def _on_change(self) -> None:
        self.state = SceneState()
        self._known.on_change()

    def grasps(self, name: str) -> GraspSet:
        """Return the grasp candidates of an object at its present pose, see ``KnownGrasps``."""
        return self._known.at(name, self.world.pose(name))

    def grasps_at(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> GraspSet:
        """Return the grasp candidates of an object at another pose, see ``KnownGrasps``."""
        return self._known.at(name, T_world_stand)

    def tilted_grasps(self, name: str) -> GraspSet:
        """Return grasps at any angle of the hand, clear of surroundings, see ``KnownGrasps``."""
        return self._known.tilted(name, self.world.pose(name))

    def keeping_grasps(self, name: str) -> GraspSet:
        """Return such grasps with which an object keeps its orientation, see ``KnownGrasps``."""
        return self._known.keeping(name, self.world.pose(name))

    def _points_around(self, name: str) -> Float[np.ndarray, "n 3"]:
        """Return points of what is around an object, in its stand frame [m]."""
        T = self.world.pose(name)
        others = [(self.items[other], pose) for other, pose in self.poses().items() if other != name]
        return points_around(T[:3, 3], others, self.perceived_obstacles, self._surfaces) @ T[:3, :3]

    def bowls_in(self, name: str) -> tuple[str, ...]:
        """Return the names of the upright bowls in the cavity of a bowl; none if it holds anything else."""
        item, poses = self.items[name], self.poses()
        inside = [n for n, T in poses.items() if n != name and holds(item, poses[name], [(self.items[n], T)])]
        are_bowls = all(self.items[n].category == "bowl" and not lies(poses[n]) for n in (name, *inside))
        return tuple(inside) if are_bowls else ()
