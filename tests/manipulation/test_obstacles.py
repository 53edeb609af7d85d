import pytest

from manipulation.obstacles import BOX_FLOOR, TABLE, box_obstacles
from manipulation.types import Box


def test_box_walls_stand_around_the_inside():
    parts = {part.name: part for part in box_obstacles(Box(center=(0.5, 0.2), size=(0.3, 0.2, 0.08)))}
    assert len(parts) == 5
    assert parts["box_wall_x_far"].center[0] - parts["box_wall_x_far"].half_size[0] == pytest.approx(0.65)
    assert parts["box_wall_y_near"].center[1] + parts["box_wall_y_near"].half_size[1] == pytest.approx(0.1)
    assert 2 * parts["box_wall_x_far"].half_size[2] == pytest.approx(0.084)
    assert 2 * parts[BOX_FLOOR].half_size[2] == pytest.approx(0.004)


def test_walls_enclose_the_inside_on_all_four_sides():
    box = Box(center=(0.5, 0.2), size=(0.3, 0.2, 0.08))
    inner = {}
    for part in box_obstacles(box):
        if part.name == BOX_FLOOR:
            continue
        axis = 0 if "_x_" in part.name else 1
        sign = 1 if "far" in part.name else -1
        inner[part.name] = part.center[axis] - sign * part.half_size[axis]
        assert 2 * part.half_size[axis] == pytest.approx(box.wall)
        # Along the wall: the inside and both corners.
        assert part.half_size[1 - axis] == pytest.approx(box.size[1 - axis] / 2 + box.wall)
        assert part.center[2] - part.half_size[2] == pytest.approx(0.0)
    assert inner == pytest.approx(
        {"box_wall_x_near": 0.35, "box_wall_x_far": 0.65, "box_wall_y_near": 0.1, "box_wall_y_far": 0.3}
    )


def test_the_table_top_is_at_height_zero():
    assert TABLE.center[2] + TABLE.half_size[2] == pytest.approx(0.0)
