"""Static obstacles of known geometry: axis-aligned boxes for the table and the walls of an open box."""

from __future__ import annotations

from dataclasses import dataclass

from manipulation.types import Box

BOX_FLOOR = "box_floor"


@dataclass(frozen=True)
class Obstacle:
    """An axis-aligned box in the world frame.

    Attributes:
        name: unique identifier in the collision world.
        center: (x, y, z) in [m].
        half_size: half extents along x, y and z in [m].
    """

    name: str
    center: tuple[float, float, float]
    half_size: tuple[float, float, float]


TABLE = Obstacle("table", (0.45, 0.0, -0.025), (0.65, 0.60, 0.025))


def box_obstacles(box: Box) -> tuple[Obstacle, ...]:
    """Return the floor and the four walls of a box."""
    (x, y), (length, width, _), wall = box.center, box.size, box.wall
    middle, half = box.top / 2, box.top / 2
    along, across = length / 2 + wall, width / 2 + wall
    parts = [Obstacle(BOX_FLOOR, (x, y, box.floor / 2), (along, across, box.floor / 2))]
    for side, name in ((-1, "near"), (1, "far")):
        wall_x = x + side * (length / 2 + wall / 2)
        parts.append(Obstacle(f"box_wall_x_{name}", (wall_x, y, middle), (wall / 2, across, half)))
        wall_y = y + side * (width / 2 + wall / 2)
        parts.append(Obstacle(f"box_wall_y_{name}", (x, wall_y, middle), (along, wall / 2, half)))
    return tuple(parts)
