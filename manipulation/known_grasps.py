"""Grasp candidates of the objects in a scene, generated once for each state of what they depend on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from manipulation.antipodal_grasps import antipodal_grasps
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates, grasps_from_above
from manipulation.lying_grasps import lies, lying_grasps
from manipulation.reorientation import reorienting_grasps
from manipulation.types import RIMMED, GraspSet, StandingObject

_UP = np.array([0.0, 0.0, 1.0])
_NONE = GraspSet((), Counter())


class KnownGrasps:
    """Grasp candidates by name.

    Those of an object that stands depend on its shape alone, those of one that does not on its pose as well,
    and those with the hand at any angle on everything around.

    Args:
        items: All objects by name.
        config: Settings of grasp generation.
        points_around: Returns points of what is around an object, in its stand frame [m].
        standing: Candidates that are known already.
    """

    def __init__(
        self,
        items: Mapping[str, StandingObject],
        config: GraspConfig,
        points_around: Callable[[str], Float[np.ndarray, "n 3"]],
        standing: Mapping[str, GraspSet] | None = None,
    ) -> None:
        self._items, self._config, self._points_around = items, config, points_around
        self._standing = dict(standing or {})
        self._lying: dict[str, GraspSet] = {}
        self._tilted: dict[str, GraspSet] = {}
        self._keeping: dict[str, GraspSet] = {}

    def on_move(self, name: str) -> None:
        """Forget what depends on the pose of an object."""
        self._lying.pop(name, None)

    def on_change(self) -> None:
        """Forget what depends on the scene."""
        self._tilted.clear()
        self._keeping.clear()

    def at(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> GraspSet:
        """Return the candidates of an object at a pose: with which it is turned, if it does not stand."""
        item = self._items[name]
        if lies(T_world_stand):
            if name not in self._lying:
                self._lying[name] = reorienting_grasps(item, T_world_stand, self._config)
            return self._lying[name]
        if name not in self._standing:
            self._standing[name] = grasp_candidates(item, self._config)
        return self._standing[name]

    def tilted(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> GraspSet:
        """Return grasps with which an object is turned, or kept as it is if it stands, clear of surroundings.

        The hand is at any angle.
        """
        if name not in self._tilted:
            self._tilted[name] = (
                reorienting_grasps(self._items[name], T_world_stand, self._config, self._points_around(name))
                if lies(T_world_stand)
                else self.keeping(name, T_world_stand)
            )
        return self._tilted[name]

    def keeping(self, name: str, T_world_stand: Float[np.ndarray, "4 4"]) -> GraspSet:
        """Return grasps at any angle, clear of surroundings, with which an object keeps its orientation.

        One that leans is set upright. Of one on its side, grasps across its axis come first; of an upright
        mug or bowl, those at the uppermost part of its rim, with the fingertips over what it stands in, and
        last those with the fingers near to its wall.
        """
        if name not in self._keeping:
            self._keeping[name] = self._make_keeping(name, T_world_stand)
        return self._keeping[name]

    def _make_keeping(self, name: str, T: Float[np.ndarray, "4 4"]) -> GraspSet:
        item, config = self._items[name], self._config
        up, keeps = T[2, :3], lies(T) or T[2, 2] > 1 - 1e-6
        between = antipodal_grasps(item, (up,) if keeps else (up, _UP), config, self._points_around(name))
        if not lies(T):
            shallow, narrow = (
                grasps_from_above(item, at_rim) if item.category in RIMMED and keeps else _NONE
                for at_rim in (config.shallow(), config.shallow().narrow())
            )
            grasps = shallow.grasps + between.grasps + narrow.grasps
            return GraspSet(grasps, shallow.rejected + between.rejected + narrow.rejected)
        across = lying_grasps(item, T, config, least_height=0.0)
        return GraspSet(across.grasps + between.grasps, across.rejected + between.rejected)
