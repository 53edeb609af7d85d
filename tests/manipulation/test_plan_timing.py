"""Tests of the timing of a plan's joint moves."""

import numpy as np
import pytest

from manipulation.carrying import MAX_TORQUE, inertial_torque
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, Obstacle
from manipulation.pick_place import PickPlacePlanner
from manipulation.plan_timing import PlanTiming
from manipulation.standing import to_standing
from perception.geometry import invert, transform_points
from tests.manipulation.test_execution import CONFIG


@pytest.fixture(scope="module")
def item(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))


def planner_of(item, arm, *obstacles):
    return PickPlacePlanner(Kinematics(arm), {item.name: item}, (TABLE, *obstacles), CONFIG.pick_place)


@pytest.fixture(scope="module")
def carried(item, arm):
    """Grasp at the centre, whose inertia slows nothing down, and path: a turn to (0.5, 0.2) m, and down."""
    planner = planner_of(item, arm)
    kinematics, grasp = planner.kinematics, planner.scene.grasps(item.name).grasps[0]
    T_stand_tcp = grasp.T_stand_tcp.copy()
    T_stand_tcp[2, 3] = 0.55 * item.top
    grasp = grasp.held_at(T_stand_tcp)
    T, turn, down = item.T_world_stand.copy(), *np.eye(len(arm.q_home))[:2]
    T[1:3, 3] = 0.2, 0.3
    above = kinematics.inverse(T @ grasp.T_stand_tcp, [arm.q_home]).q
    return grasp, [above - 0.8 * turn, above, above + 0.3 * down]


def test_a_carried_object_does_not_stop_at_a_waypoint(item, arm, carried):
    grasp, path = carried
    planner = planner_of(item, arm)
    timing = PlanTiming(planner.motions)
    carry = timing.carry(item, grasp, path)
    parts = [timing.carry(item, grasp, path[k : k + 2]) for k in range(2)]
    assert carry.duration < sum(part.duration for part in parts) - 0.05
    np.testing.assert_allclose(carry.positions[[0, -1]], [path[0], path[-1]], atol=1e-9)
    np.testing.assert_array_equal(carry.velocities[-1], 0.0)
    assert planner.scene.world.contact(path[0], grasp.held_width) is None, "nothing is carried afterwards"
    centre = 0.5 * (item.vertices.min(axis=0) + item.vertices.max(axis=0))
    in_hand = transform_points(invert(grasp.T_stand_tcp), centre[None])[0]
    assert inertial_torque(planner.kinematics, carry, in_hand) <= 1.05 * MAX_TORQUE


def test_a_wall_beside_the_way_down_keeps_its_corner(item, arm, carried):
    """A wall just before the goal, 15 mm below the path: only a cut corner would meet it."""
    grasp, path = carried
    wall = Obstacle("wall", (0.5, 0.155, 0.1425), (0.3, 0.005, 0.1425))
    free, walled = (PlanTiming(planner_of(item, arm, *o).motions) for o in ((), (wall,)))
    cut, kept = (timing.carry(item, grasp, path) for timing in (free, walled))
    assert kept.duration > cut.duration + 0.03


def test_a_transit_over_a_waypoint_does_not_stop_there(item, arm):
    timing = PlanTiming(planner_of(item, arm).motions)
    path = [arm.q_home + angle * np.eye(len(arm.q_home))[0] for angle in (0.0, 0.6)]
    path.append(path[-1] + np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    transit = timing.transit(path, 0.08)
    speed = np.linalg.norm(transit.velocities, axis=1)
    assert speed[len(speed) // 4 : -len(speed) // 4].min() > 0.1
    np.testing.assert_allclose(transit.positions[[0, -1]], [path[0], path[-1]], atol=1e-9)
