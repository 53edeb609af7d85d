"""Lift of a grasped object: up, or obliquely away from what it touches or would meet.

What is held far from its middle sags: it turns about the line through both pads, the heavy end down, by a
few degrees that no plan knows. A lift is therefore checked with the object sagging as well. An object that
touches another one leaves it obliquely where there is room: dragged up along it, it may tip it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from manipulation.collision import AllowedContacts, CollisionWorld
from manipulation.motions import MotionPlanner
from manipulation.obstacles import TABLE
from manipulation.standing import RAISED
from manipulation.types import Grasp, Rejected
from perception.geometry import invert, so3_exp

SLIDE_DEPTH = 0.002  # [m] by which an object may get deeper in what it is lifted along
MAX_OVERLAP = 0.008  # [m] of estimated shapes in contact
MAX_HULL_OVERLAP = 0.02  # [m] of an object and the hulls of a thing, which fill the hollow beside it
FAR = 0.05  # [m] from the pads to the object's middle, from which on it may sag
SAG = np.deg2rad(8.0)  # nine of ten bowls and bottles that are held so far away sag by less
_RISEN = 0.01  # [m] from which on the heavy end has left the table in spite of that

Postures = Float[np.ndarray, "_k n"]  # several of them in one value differ in length


@dataclass(frozen=True)
class LiftConfig:
    """Lengths and clearances of a lift.

    Attributes:
        heights: heights of the vertical lift in [m], tried in order until its end is clear.
        oblique_azimuths: azimuths in [rad] of a lift that is not vertical, from that away from what it would
            meet, tried in order.
        oblique_elevation: elevation of such a lift in [rad].
        margin: clearance of the carried object from its neighbours during the lift in [m].
        end_margin: clearance of robot and carried object at the end of the lift, from where it is carried on,
            in [m].
    """

    heights: tuple[float, ...] = (0.20, 0.12, 0.28)
    oblique_azimuths: tuple[float, ...] = (0.0, 0.8, -0.8)
    oblique_elevation: float = 0.7
    margin: float = 0.002
    end_margin: float = 0.004


def find_lift(
    motions: MotionPlanner,
    name: str,
    grasp: Grasp,
    q: Float[np.ndarray, "n"],
    T_grasp: Float[np.ndarray, "4 4"],
    config: LiftConfig = LiftConfig(),
) -> Postures | Rejected:
    """Return the postures of the lift of the carried object, or why there is none.

    It is straight up if that is free even with the object sagging. Else it is oblique, away from what the
    object touches or would sag into. If no such lift is free, it is straight up all the same, along what the
    object touches, and last oblique without regard to sagging.

    Args:
        motions: planner; its world has the object attached to the hand.
        name: the object.
        grasp: how it is held.
        q: posture of the grasp in [rad].
        T_grasp: pose of the TCP there.
        config: settings.
    """
    return _Lift(motions, name, grasp, q, T_grasp, config).find()


@dataclass(frozen=True)
class _Lift:
    """Search for one lift; the attributes are the arguments of ``find_lift``."""

    motions: MotionPlanner
    name: str
    grasp: Grasp
    q: Float[np.ndarray, "n"]
    T_grasp: Float[np.ndarray, "4 4"]
    config: LiftConfig

    def find(self) -> Postures | Rejected:
        upward = [moved(self.T_grasp, np.array([0.0, 0.0, height])) for height in self.config.heights]
        allowed = AllowedContacts(touch_carried=frozenset({TABLE.name}), carried_margin=self.config.margin)
        lift, beside = self._line(upward, allowed), ""
        if isinstance(lift, Rejected):
            touching = in_contact(self.motions.world, self.name, self.q, self.grasp.held_width, allowed)
            if touching is not None:
                along = touching.slide_carried
                beside = max(along, key=along.__getitem__, default="")
                allowed, lift = touching, self._line(upward, touching)
        else:
            beside = self._sags_into(lift, allowed)
        if beside:
            oblique = self._oblique(beside, allowed)
            steady = next((line for line in oblique if not self._sags_into(line, allowed)), None)
            if steady is not None:
                return steady
        if not isinstance(lift, Rejected) or not lift.blocker or lift.by_arm:
            return lift
        return next(self._oblique(lift.blocker, allowed), lift)

    def _line(
        self, targets: Sequence[Float[np.ndarray, "4 4"]], allowed: AllowedContacts
    ) -> Postures | Rejected:
        width, end_margin = self.grasp.held_width, self.config.end_margin
        return self.motions.free_line(self.q, targets, width, allowed, end_margin)

    def _oblique(self, blocker: str, allowed: AllowedContacts) -> Iterator[Postures]:
        """Yield free lifts away from something, by its name."""
        world, config = self.motions.world, self.config
        away = world.pose(self.name)[:2, 3] - world.center(blocker)[:2]
        for turn in config.oblique_azimuths:
            azimuth = np.arctan2(away[1], away[0]) + turn
            level = np.cos(config.oblique_elevation)
            up = np.sin(config.oblique_elevation)
            direction = np.array([level * np.cos(azimuth), level * np.sin(azimuth), up])
            line = self._line([moved(self.T_grasp, height * direction) for height in config.heights], allowed)
            if not isinstance(line, Rejected):
                yield line

    def _sags_into(self, lift: Postures, allowed: AllowedContacts) -> str:
        """Return the name of what the object would meet in a lift if it sagged; empty if there is nothing."""
        world, kinematics = self.motions.world, self.motions.kinematics
        lever = world.center(self.name) - self.T_grasp[:3, 3]
        if np.linalg.norm(lever[:2]) < FAR:
            return ""
        closing = self.T_grasp[:3, 1]
        sense = np.sign(closing @ np.cross(lever, (0.0, 0.0, -1.0)))
        T_sag = np.eye(4)
        T_sag[:3, :3] = so3_exp(sense * SAG * np.array([0.0, 1.0, 0.0]))
        risen = [kinematics.forward(q)[2, 3] > self.T_grasp[2, 3] + _RISEN for q in lift]
        T_tcp_object = invert(self.grasp.T_stand_tcp)
        world.carry(self.name, T_sag @ T_tcp_object)
        try:
            contact = world.path_contact(lift[np.array(risen)], self.grasp.held_width, allowed)
        finally:
            world.carry(self.name, T_tcp_object)
        return contact.obstacle if contact is not None else ""


def in_contact(
    world: CollisionWorld, name: str, q: np.ndarray, width: float, allowed: AllowedContacts
) -> AllowedContacts | None:
    """Return ``allowed`` with what an object in its place may touch; None if it touches nothing or is stuck.

    It slides along what it touches, hardly deeper in it than it is now: estimated shapes overlap. Hulls close
    cavities, so that it may be deep in what it stands in or on.
    """
    around, along = set(allowed.touch_carried), {}
    for other, depth in world.carried_overlaps(q, width).items():
        if other in allowed.touch_carried:
            continue
        is_object = other in world.names
        if is_object and world.base(name) > world.base(other) + (RAISED if depth < MAX_OVERLAP else 0.0):
            around.add(other)
        elif depth > (MAX_HULL_OVERLAP if other in world.perceived else MAX_OVERLAP):
            return None
        else:
            along[other] = max(depth, 0.0) + SLIDE_DEPTH
    if not along and around == allowed.touch_carried:
        return None
    return replace(allowed, touch_carried=frozenset(around), slide_carried=along)


def moved(T: Float[np.ndarray, "4 4"], step: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Return a pose translated by a step [m]."""
    T_moved = T.copy()
    T_moved[:3, 3] += step
    return T_moved
