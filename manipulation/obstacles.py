"""The fixed things around the arm: upright boxes, known beforehand rather than perceived."""

from __future__ import annotations

from dataclasses import dataclass

from manipulation.types import Box

BOX_FLOOR = "box_floor"


@dataclass(frozen=True)
class Furniture:
    """A fixed upright box, such as the table or a wall: centre and half sizes in [m], world frame."""

    name: str
    center: tuple[float, float, float]
    half_size: tuple[float, float, float]


TABLE = Furniture("table", (0.45, 0.0, -0.025), (0.65, 0.60, 0.025))


def box_walls(box: Box) -> tuple[Furniture, ...]:
    """Floor and walls of a box."""
    (x, y), (length, width, _), wall = box.center, box.size, box.wall
    middle, half = box.top / 2, box.top / 2
    along, across = length / 2 + wall, width / 2 + wall
    parts = [Furniture(BOX_FLOOR, (x, y, box.floor / 2), (along, across, box.floor / 2))]
    for side, name in ((-1, "near"), (1, "far")):
        away = x + side * (length / 2 + wall / 2)
        parts.append(Furniture(f"box_wall_x_{name}", (away, y, middle), (wall / 2, across, half)))
        away = y + side * (width / 2 + wall / 2)
        parts.append(Furniture(f"box_wall_y_{name}", (x, away, middle), (along, wall / 2, half)))
    return tuple(parts)
