"""Pedestals reach from the table to the arm's lowest fixed part, in planning and in scenes."""

import numpy as np
import pytest

from sim_assets.cell.scene import build_scene
from sim_assets.rendering.headless import mujoco
from sim_assets.robots import load_robot
from sim_assets.robots.pedestal import pedestal_of

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def test_an_arm_on_the_table_has_none(sliding_model):
    assert pedestal_of(sliding_model, "turn", np.zeros(3), LEVEL) is None


def test_height_and_place(sliding_model):
    """The foot of the arm is a box on z = 0, its first axis at x = y = 0 of its file."""
    half_turn = np.array([0.0, 0.0, 0.0, 1.0])
    column = pedestal_of(sliding_model, "turn", np.array([0.1, -0.2, 0.3]), half_turn)
    assert (column.x, column.y) == pytest.approx((0.1, -0.2))
    assert column.height == pytest.approx(0.3, abs=2e-3)
    assert column.shape["pos"][2] == column.shape["size"][2] == column.height / 2


def test_scenes_and_planning_have_the_same_column(write):
    robot = load_robot(str(write(arm="base = [0.0, 0.0, 0.25]")))
    scene = build_scene([], [], None, np.random.default_rng(0), robot=robot).compile()
    planned = mujoco.MjModel.from_xml_string(robot.description.mjcf)
    for model in (scene, planned):
        geom = model.geom("robot_pedestal")
        assert geom.pos[2] == pytest.approx(0.1245, abs=1e-3) and geom.size[2] == pytest.approx(geom.pos[2])
