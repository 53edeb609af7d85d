"""What execution asks of perception while it runs, and the decisions on the answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from manipulation.types import Grasp
from perception.geometry import nearest_yaw, wrapped_angle
from perception.obstacles.obstacle import PerceivedObstacle

Poses = Mapping[str, Float[np.ndarray, "4 4"]]  # T_world_stand by name
Volume = Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, "n"]]  # which world points [m] are in it
Grip = Literal["held", "empty", "wide"]
Presence = Literal["in_place", "displaced", "unseen"]

MOVED = 0.012  # [m] horizontally, from which on an object is not where it was expected
TIPPED = np.deg2rad(20.0)  # of its axis from the expected direction
LEVER = 0.08  # [m] from the middle of an object on its side to where a turn moves it as much as a shift
FEWEST_UNKNOWN = 60  # points of ``unexpected`` from which on they are a thing
TURNED = np.deg2rad(10.0)  # about the vertical, from which on the handle of a mug is elsewhere


@dataclass(frozen=True)
class Finding:
    """Result of a search for an object.

    Attributes:
        status: "found"; "missing" if it is not on the visible table; "unseen" if nothing is known.
        T_world_stand: (4, 4) pose of its stand frame, in any orientation; None unless found.
        obstacles: things of no class as the images of the search show them; None if it did not see the table.
    """

    status: Literal["found", "missing", "unseen"]
    T_world_stand: Float[np.ndarray, "4 4"] | None = None
    obstacles: tuple[PerceivedObstacle, ...] | None = None


@runtime_checkable
class SceneObserver(Protocol):
    """Looks at the scene with the wrist camera."""

    def glance(self, poses: Poses, names: tuple[str, ...]) -> Mapping[str, Presence]:
        """Return from one image, without a motion, which of the named objects are where they are expected.

        Args:
            poses: expected poses of all objects.
            names: objects to check.
        """
        ...

    def unexpected(
        self, poses: Poses, obstacles: Sequence[PerceivedObstacle], region: Volume
    ) -> Float[np.ndarray, "n 3"]:
        """Return the world points [m] in a region that one image shows and that nothing known explains.

        Args:
            poses: expected poses of all objects.
            obstacles: known things of no class.
            region: where unknown things are looked for.
        """
        ...

    def held(
        self, name: str, poses: Poses, T_world_tcp: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """Return T_world_stand of the object in the hand from one image, without a motion; None if not seen.

        Args:
            name: the object.
            poses: expected poses of all objects; of those in the hand, if nothing has shifted there.
            T_world_tcp: (4, 4) pose of the TCP.
        """
        ...

    def find(self, name: str, poses: Poses) -> Finding:
        """Move the camera and search for an object: first where it is expected, then on the whole table."""
        ...

    def find_obstacles(self, poses: Poses) -> tuple[PerceivedObstacle, ...] | None:
        """Move the camera and return the things of no class on the table; None if it cannot be seen.

        Args:
            poses: poses of the known objects, which are none.
        """
        ...

    def look_closer(self, names: Sequence[str], poses: Poses) -> Poses:
        """Move the camera to objects that touch each other, the uppermost first.

        Returns the pose of each that is seen near where it is expected, with its tilt.
        """
        ...


class NoObserver:
    """Sees nothing; execution then relies on the width between the fingers alone."""

    def glance(self, poses: Poses, names: tuple[str, ...]) -> Mapping[str, Presence]:
        return {}

    def unexpected(
        self, poses: Poses, obstacles: Sequence[PerceivedObstacle], region: Volume
    ) -> Float[np.ndarray, "n 3"]:
        return np.zeros((0, 3))

    def held(self, name: str, poses: Poses, T_world_tcp: Float[np.ndarray, "4 4"]) -> None:
        return None

    def find(self, name: str, poses: Poses) -> Finding:
        return Finding("unseen")

    def find_obstacles(self, poses: Poses) -> None:
        return None

    def look_closer(self, names: Sequence[str], poses: Poses) -> Poses:
        return {}


def classify_grip(width: float, grasp: Grasp) -> Grip:
    """Return what a width between the closed pads [m] means for a grasp."""
    low, high = grasp.closed_width
    return "empty" if width < low else "wide" if width > high else "held"


def is_displaced(
    T_expected: Float[np.ndarray, "4 4"],
    T_seen: Float[np.ndarray, "4 4"],
    moved: float = MOVED,
    tipped: float = TIPPED,
) -> bool:
    """Return whether an object is not where it was expected: shifted by ``moved`` [m], or its axis turned.

    A rotation about its axis and a difference in height do not count: they are uncertain for round objects
    and for those on others. The axis of an object on its side may turn less: fingers that close on a neck
    meet it elsewhere.

    Args:
        T_expected, T_seen: (4, 4) poses T_world_stand.
        moved: horizontal shift in [m].
        tipped: turn of the axis in [rad].
    """
    shift = float(np.linalg.norm((T_seen - T_expected)[:2, 3]))
    turn = float(np.arccos(np.clip(T_seen[:3, 2] @ T_expected[:3, 2], -1.0, 1.0)))
    is_on_side = abs(T_expected[2, 2]) < np.sqrt(0.5)
    return shift > moved or bool(turn > (min(tipped, moved / LEVER) if is_on_side else tipped))


def is_turned(
    T_expected: Float[np.ndarray, "4 4"], T_seen: Float[np.ndarray, "4 4"], turned: float = TURNED
) -> bool:
    """Return whether an object was turned about the vertical: the handles of mugs are aligned."""
    return bool(abs(turn_between(T_expected, T_seen)) > turned)


def turn_between(T_expected: Float[np.ndarray, "4 4"], T_seen: Float[np.ndarray, "4 4"]) -> float:
    """Return the angle [rad] in [-pi, pi) by which an object was turned about the vertical."""
    return wrapped_angle(nearest_yaw(T_seen) - nearest_yaw(T_expected))
