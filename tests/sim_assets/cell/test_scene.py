"""The specification of a cell: physics, contact, box, tape, cameras, inertia and collision geoms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_assets.cell.layout import PlanarPose
from sim_assets.cell.scene import VIEWS, BoxConfig, build_scene
from sim_assets.objects import sample_object
from sim_assets.rendering.headless import mujoco


@pytest.fixture(scope="module")
def cell():
    rng = np.random.default_rng(3)
    models = tuple(sample_object(category, "test", rng) for category in ("bottle", "can"))
    places = (PlanarPose(0.4, -0.2, 0.5), PlanarPose(0.5, -0.3, 1.0))
    line = ((0.66, 0.16), (-0.1, 0.56))
    return models, build_scene(
        models, places, BoxConfig(inner=(0.3, 0.2, 0.07), center=(0.45, 0.3)), rng, line
    ).compile()


def test_physics_options_and_contact_parameters(cell):
    _, model = cell
    option = model.opt
    assert option.timestep == 0.002 and option.impratio == 10
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    np.testing.assert_allclose(option.gravity, (0, 0, -9.81))
    assert option.disableflags == 0 and option.enableflags == 0  # no sleeping bodies, no contact override
    for name in ("left_pad", "right_pad"):
        pad = model.geom(name)
        np.testing.assert_allclose(pad.friction, (1.0, 0.01, 0.0005))
        np.testing.assert_allclose(pad.solref, (0.004, 1))
        assert pad.priority == 1 and pad.condim == 4
    for name in ("object0_piece0", "object1_piece0", "table", "box_floor"):
        np.testing.assert_allclose(model.geom(name).friction, (0.6, 0.005, 0.0001))
        assert model.geom(name).priority == 0 and model.geom(name).condim == 4
    np.testing.assert_allclose(model.actuator("gripper").forcerange, (-140, 140))


def test_arm_collides_with_everything_but_itself(cell):
    _, model = cell

    def meets(a, b):
        first, second = model.geom(a), model.geom(b)
        return bool(first.contype & second.conaffinity or second.contype & first.conaffinity)

    assert meets("left_pad", "object0_piece0") and meets("link4_collision0", "table")
    assert meets("object0_piece0", "object1_piece0") and meets("object0_piece0", "box_floor")
    assert not meets("left_pad", "right_pad") and not meets("link5_collision0", "hand_collision0")
    assert not meets("left_pad", "tape") and not meets("left_pad", "object0_visual")


def test_box_has_its_inner_size(cell):
    _, model = cell
    walls = [("front", 0, 1, 0.15), ("back", 0, -1, 0.15), ("left", 1, 1, 0.10), ("right", 1, -1, 0.10)]
    floor = model.geom("box_floor")
    for name, axis, sign, half in walls:
        wall = model.geom(f"box_{name}")
        assert sign * wall.pos[axis] - wall.size[axis] == pytest.approx(half), name
        assert wall.size[axis] == pytest.approx(0.004), name
        assert wall.pos[2] + wall.size[2] - (floor.pos[2] + floor.size[2]) == pytest.approx(0.07), name
        assert wall.pos[2] - wall.size[2] == pytest.approx(0.0, abs=1e-9), name
        assert wall.size[1 - axis] >= (0.10 if axis == 0 else 0.15) - 1e-9, name
    np.testing.assert_allclose(floor.size, (0.15, 0.10, 0.002))
    np.testing.assert_allclose(model.body("box").pos, (0.45, 0.3, 0.0))


def test_bodies_have_mass_and_centre_of_their_models(cell):
    models, model = cell
    for index, expected in enumerate(models):
        assert model.body(f"object{index}").mass[0] == pytest.approx(expected.mass)
        assert model.body(f"object{index}").ipos[2] == pytest.approx(expected.mesh.center_mass[2], abs=1e-5)


def test_table_top_is_at_zero_and_tape_joins_its_ends(cell):
    _, model = cell
    table, tape = model.geom("table"), model.geom("tape")
    assert table.pos[2] + table.size[2] == pytest.approx(0.0)
    np.testing.assert_allclose(2 * table.size[:2], (1.3, 1.2))
    assert model.geom("floor").pos[2] == -0.75
    along = Rotation.from_quat(tape.quat, scalar_first=True).apply((tape.size[0], 0, 0))
    np.testing.assert_allclose(tape.pos[:2] + along[:2], (-0.1, 0.56), atol=1e-9)
    np.testing.assert_allclose(tape.pos[:2] - along[:2], (0.66, 0.16), atol=1e-9)


@pytest.mark.parametrize("name", VIEWS)
def test_fixed_cameras_look_at_their_targets_upright(cell, name):
    _, model = cell
    camera, view = model.camera(name), VIEWS[name]
    right, up, backward = Rotation.from_quat(camera.quat, scalar_first=True).as_matrix().T
    away = np.array(view.position) - view.target
    np.testing.assert_allclose(backward, away / np.linalg.norm(away), atol=1e-9)
    assert up[2] > 0 and abs(right[2]) < 1e-9
    np.testing.assert_allclose(camera.pos, view.position)
    assert camera.fovy[0] == view.fovy
