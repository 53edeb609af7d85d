"""The cell's parts: inertia, box, materials on meshes, what is drawn for a task, ground truth of a grasp."""

import numpy as np
import pytest
import trimesh

from sim_assets.cell.layout import PlanarPose
from sim_assets.cell.scene import BoxConfig, add_object, build_scene
from sim_assets.objects import sample_object
from sim_assets.objects.sampling import NESTING_STEP, draw_objects, nestable
from sim_assets.rendering.headless import mujoco
from sim_assets.rendering.materials import (
    TEXTURE_SIZE,
    Finish,
    around,
    random_finish,
    random_ground,
    solid,
    wood,
)


@pytest.fixture(scope="module")
def cell():
    rng = np.random.default_rng(3)
    models = tuple(sample_object(category, "test", rng) for category in ("bottle", "can"))
    places = (PlanarPose(0.4, -0.2, 0.5), PlanarPose(0.5, -0.3, 1.0))
    line = ((0.66, 0.16), (-0.1, 0.56))
    return models, build_scene(models, places, BoxConfig(inner=(0.3, 0.2, 0.07)), rng, line).compile()


def test_physics_is_what_grasps_were_measured_with(cell):
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


def test_arm_touches_everything_but_itself(cell):
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
    front, left, floor = (model.geom(f"box_{name}") for name in ("front", "left", "floor"))
    assert front.pos[0] - front.size[0] == pytest.approx(0.15)
    assert left.pos[1] - left.size[1] == pytest.approx(0.10)
    top, bottom = front.pos[2] + front.size[2], floor.pos[2] + floor.size[2]
    assert top - bottom == pytest.approx(0.07)


def test_bodies_weigh_what_their_models_say(cell):
    models, model = cell
    for index, expected in enumerate(models):
        assert model.body(f"object{index}").mass[0] == pytest.approx(expected.mass)
        assert model.body(f"object{index}").ipos[2] == pytest.approx(expected.mesh.center_mass[2], abs=1e-5)


def test_inertia_of_a_plain_cylinder():
    """m (3 r^2 + h^2) / 12 across and m r^2 / 2 along the axis."""
    rng = np.random.default_rng(0)
    can = sample_object("can", "test", rng)
    radius, height, mass = 0.03, 0.1, can.mass
    mesh = trimesh.creation.cylinder(radius, height, sections=256)
    mesh.apply_translation((0, 0, height / 2))
    object.__setattr__(can, "mesh", mesh)
    spec = mujoco.MjSpec()
    add_object(spec, "cylinder", can, PlanarPose(0, 0, 0), random_finish(rng))
    inertia = np.sort(spec.compile().body("cylinder").inertia)
    expected = [mass * radius**2 / 2] + [mass * (3 * radius**2 + height**2) / 12] * 2
    np.testing.assert_allclose(inertia, np.sort(expected), rtol=2e-3)


def test_texture_goes_once_around_without_jumping_back():
    mesh = trimesh.creation.cylinder(0.03, 0.1, sections=32)
    uv = around(mesh).reshape(-1, 3, 2)
    sides = np.abs(mesh.face_normals[:, 2]) < 0.5
    assert np.ptp(uv[sides, :, 0], axis=1).max() == pytest.approx(1 / 32, abs=1e-6)
    assert uv[..., 1].min() == 0 and uv[..., 1].max() == 1


def test_finishes_are_repeatable_and_various():
    def draw(seed):
        return random_finish(np.random.default_rng(seed), "mug")

    assert np.array_equal(draw(3).texture, draw(3).texture)
    assert len({draw(seed).texture.tobytes() for seed in range(12)}) > 8
    assert draw(0).texture.shape == (*TEXTURE_SIZE, 3)
    for seed in range(12):
        ground = random_ground(np.random.default_rng(seed), (64, 48))
        assert ground.shape == (64, 48, 3) and ground.dtype == np.uint8


def test_wood_keeps_its_colour():
    image = wood(np.random.default_rng(0), (0.6, 0.45, 0.3)) / 255
    np.testing.assert_allclose(image.mean(axis=(0, 1)), (0.6, 0.45, 0.3), rtol=0.1)
    assert Finish(solid((1, 0, 0))).texture[0, 0].tolist() == [255, 0, 0]


def test_as_many_are_drawn_as_asked_for():
    drawn = draw_objects({"mug": 2, "can": 1}, "test", np.random.default_rng(0))
    assert sorted(model.category for model in drawn) == ["can", "mug", "mug"]


def test_bowls_of_a_set_differ_in_size():
    rng = np.random.default_rng(0)
    radii = np.sort([bowl.radius for bowl in nestable(lambda: sample_object("bowl", "test", rng), 3)])
    assert np.diff(radii).min() >= NESTING_STEP
