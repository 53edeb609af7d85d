"""Faults put in by hand: each does what its name says, once, and nothing else."""

import numpy as np
import pytest

from manipulation.robot import Robot
from sim_assets.cell import ground_truth
from sim_assets.cell.config import CellConfig
from sim_assets.cell.faults import KINDS, MOVE_DISTANCE, FaultyRobot
from sim_assets.cell.world import World
from sim_assets.objects import sample_object


@pytest.fixture(scope="module")
def cell():
    rng = np.random.default_rng(4)
    models = tuple(sample_object(c, "test", rng) for c in ("can", "bottle", "mug"))
    with World(CellConfig(models, seed=2)) as world:
        yield world, world._data.qpos.copy()


@pytest.fixture
def world(cell):
    world, qpos = cell
    yield world
    world.on_step(None)
    world.move_gripper(0.08)
    world._data.qpos[:], world._data.qvel[:] = qpos, 0.0


def before_the_first_grasp(world, kind):
    """A robot whose fault is due before the first grasp, drawn from the first seed with that moment."""
    robot = next(r for r in (FaultyRobot(world, kind, seed) for seed in range(50)) if r._closing == 0)
    assert isinstance(robot, Robot) and robot.record is None
    robot.move_gripper(0.06)
    return robot


def poses(world):
    return ground_truth.object_poses(world)


def test_an_object_is_moved_by_5_cm_and_stands(world):
    before = poses(world)
    robot = before_the_first_grasp(world, "move")
    world.wait(0.5)
    shifts = {i: np.linalg.norm((T - before[i])[:3, 3]) for i, T in poses(world).items()}
    assert shifts.pop(robot.record.object) == pytest.approx(MOVE_DISTANCE, abs=2e-3)
    assert max(shifts.values()) < 1e-3
    assert poses(world)[robot.record.object][2, 2] > 0.999


def test_an_object_is_knocked_over_and_comes_to_rest_on_the_table(world):
    robot = before_the_first_grasp(world, "knock-over")
    world.wait(3.0)
    T = poses(world)[robot.record.object]
    assert T[2, 2] < 0.5 and T[2, 3] > -0.05
    upright = [T[2, 2] for i, T in poses(world).items() if i != robot.record.object]
    assert min(upright) > 0.99
    world.wait(1.0)
    assert np.linalg.norm((poses(world)[robot.record.object] - T)[:3, 3]) < 2e-3


def test_an_object_is_taken_away(world):
    robot = before_the_first_grasp(world, "take-away")
    assert poses(world)[robot.record.object][1, 3] > 2


def test_the_fault_occurs_once_and_is_recorded(world):
    robot = before_the_first_grasp(world, "move")
    record, before = robot.record, poses(world)
    assert robot.as_dict() == {"kind": "move", "object": record.object, "time": record.time}
    for width in (0.0, 0.06, 0.0, 0.06):
        robot.move_gripper(width)
    assert robot.record is record
    for i, T in poses(world).items():
        np.testing.assert_allclose(T, before[i], atol=2e-3)


def test_fingers_pass_through_the_object_of_a_missed_grasp(world):
    robot = FaultyRobot(world, "missed-grasp", 1)
    robot._closing = 1
    bodies, start = robot._bodies, poses(world)
    number = bodies.nearest_to_tcp()
    assert robot.move_gripper(0.0) < 1e-3 and robot.record.object == number
    world.wait(0.1)
    assert (world._model.geom_contype[bodies._fingers] == bodies._contype).all(), "clear of it, they touch"
    np.testing.assert_allclose(poses(world)[number], start[number], atol=1e-3)


def test_an_object_slips_at_the_drawn_height(world):
    robot = FaultyRobot(world, "slip", 3)
    robot._closing = 1
    number = robot._bodies.nearest_to_tcp()
    robot.move_gripper(0.0)
    assert robot.record is None
    joint = world._data.joint(f"object{number}")
    joint.qpos[2] += robot._height - 0.004
    world.wait(0.004)
    assert robot.record is None
    joint.qpos[2] += 0.02
    world.wait(0.004)
    assert robot.record.kind == "slip" and robot.record.object == number


def test_the_same_seed_draws_the_same_fault(world):
    for kind in KINDS:
        first, second = FaultyRobot(world, kind, 7), FaultyRobot(world, kind, 7)
        assert (first._closing, first._height) == (second._closing, second._height)
        assert len({FaultyRobot(world, kind, seed)._closing for seed in range(20)}) == 3
