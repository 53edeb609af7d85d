"""Partial layouts: places, nests, releases, ranks."""

from dataclasses import replace

import numpy as np

from manipulation.footprints import BoxRaster
from manipulation.layouts import Layout, unreleasable
from manipulation.types import Box

BOX = Box(size=(0.3, 0.26, 0.08))


def empty_layout(problem):
    return Layout(problem, BoxRaster(problem.box, 0.0))


def test_objects_take_the_free_cell_of_least_cost_at_the_first_yaw_that_fits(shapes, problem_of):
    narrow = Box(size=(0.08, 0.16, 0.08))
    problem = problem_of(("bottle", shapes.flat_bottle(0.05, 0.12)), ("can", shapes.can(0.03)), box=narrow)
    layout = empty_layout(problem)
    towards_front = layout.raster.centers[..., 1]
    layout.place("bottle_0", (np.pi / 2, 0.0), towards_front, 0.005)
    assert layout.yaws == {"bottle_0": 0.0}, "across the box it does not fit"
    x, y = layout.positions["bottle_0"]
    assert 0.005 - 1e-3 <= y - (0.06 - 0.08) <= 0.005 + 0.005, "a gap from the front wall"
    i, j = layout.raster.cell_of(layout.positions["bottle_0"])
    assert (layout.raster.x[i], layout.raster.y[j]) == (x, y), "in the middle of a cell"
    layout.place("can_1", (0.0,), towards_front, 0.005)
    assert layout.left_out == ["can_1"] and "can_1" not in layout.positions


def test_cells_of_infinite_cost_are_never_taken(shapes, problem_of):
    layout = empty_layout(problem_of(("can", shapes.can()), box=BOX))
    layout.place("can_0", (0.0,), np.full(layout.raster.taken.shape, np.inf), 0.005)
    assert layout.left_out == ["can_0"]


def test_objects_keep_the_gap(shapes, problem_of):
    layout = empty_layout(problem_of(*[("can", shapes.can(0.03))] * 2, box=BOX))
    cost = np.linalg.norm(layout.raster.centers, axis=-1)
    for name in ("can_0", "can_1"):
        layout.place(name, (0.0,), cost, 0.02)
    distance = np.linalg.norm(layout.positions["can_0"] - layout.positions["can_1"])
    assert 0.06 + 0.02 - 0.005 <= distance <= 0.06 + 0.02 + 0.01  # cells of 5 mm


def test_upper_bowls_follow_the_lowest_or_are_left_out_with_it(shapes, problem_of):
    problem = problem_of(("bowl", shapes.bowl(0.075)), ("bowl", shapes.bowl(0.06, 0.045)), box=BOX)
    ((lowest, upper),) = problem.stacks
    layout = empty_layout(problem)
    layout.put(lowest.name, np.array([0.02, -0.03]), 0.4)
    layout.nest([lowest, upper])
    assert layout.yaws[upper.name] == 0.4
    np.testing.assert_array_equal(layout.positions[upper.name], (0.02, -0.03))
    without = empty_layout(problem)
    without.nest([lowest, upper])
    assert without.left_out == [upper.name]


def test_releases_are_counted_in_the_order_of_execution(shapes, problem_of):
    """A low can in a ring of tall ones is released before them; a tall one there has no room for fingers."""
    angles = 2 * np.pi * np.arange(6) / 6
    ring = 0.064 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for middle, is_blocked in ((0.07, False), (0.14, True)):
        cans = [("can", shapes.can(0.03, middle)), *[("can", shapes.can(0.03, 0.13))] * 6]
        problem = problem_of(*cans, box=BOX, grasped=True)
        layout = empty_layout(problem)
        layout.put("can_0", np.zeros(2), 0.0)
        for number, place in enumerate(ring):
            layout.put(f"can_{number + 1}", place, 0.0)
        layout.count_releases()
        assert ("can_0" in layout.blocked) == is_blocked


def test_what_comes_later_is_released_beside_all_others(shapes, problem_of):
    cans = [("can", shapes.can(0.03, 0.07)), *[("can", shapes.can(0.03, 0.13))] * 6]
    problem = problem_of(*cans, box=BOX, grasped=True)
    layout = empty_layout(replace(problem, later=frozenset({"can_0"})))
    layout.put("can_0", np.zeros(2), 0.0)
    for number, angle in enumerate(2 * np.pi * np.arange(6) / 6):
        layout.put(f"can_{number + 1}", 0.064 * np.array([np.cos(angle), np.sin(angle)]), 0.0)
    layout.count_releases()
    assert "can_0" in layout.blocked


def test_counting_twice_does_not_add_up(shapes, problem_of):
    layout = empty_layout(problem_of(("can", shapes.can()), box=BOX, grasped=True))
    layout.put("can_0", np.zeros(2), 0.0)
    layout.count_releases()
    freedom = layout.freedom
    layout.count_releases()
    assert layout.freedom == freedom > 0 and not layout.blocked


def test_ranks_prefer_what_is_in_place_then_freedom_then_a_small_area(shapes, problem_of):
    problem = problem_of(*[("can", shapes.can())] * 2, box=BOX)

    def layout(left_out=(), blocked=(), freedom=0, apart=0.1):
        one = empty_layout(problem)
        one.put("can_0", np.zeros(2), 0.0)
        one.put("can_1", np.array([apart, 0.0]), 0.0)
        one.left_out, one.blocked, one.freedom = list(left_out), list(blocked), freedom
        return one

    ascending = [
        layout(freedom=8),
        layout(freedom=4, apart=0.08),
        layout(freedom=4),
        layout(blocked=["can_0"], freedom=8),
        layout(left_out=["can_0"], freedom=8),
        layout(left_out=["can_0"], blocked=["can_1"], freedom=9),
    ]
    ranks = [one.rank() for one in ascending]
    assert ranks == sorted(ranks) and len(set(ranks)) == len(ranks)


def test_what_no_hand_can_release_in_the_empty_box_is_named(shapes, problem_of):
    kinds = [("can", shapes.can(height=0.12)), ("can", shapes.can(height=0.10))]
    problem = problem_of(*kinds, box=BOX, grasped=True)
    assert unreleasable(problem) == frozenset()
    narrow = problem_of(*kinds, box=Box(size=(0.09, 0.09, 0.2)), grasped=True)
    assert unreleasable(narrow) == {"can_0", "can_1"}, "walls of 20 cm leave no room for the palm"
