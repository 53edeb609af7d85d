"""Dropped toys: free fall, release times, slanted supports, rendering."""

import numpy as np
import pytest
import trimesh

from perception.types import CameraIntrinsics, SupportPlane
from sim_assets.cell.drop_world import DropWorld, HeightField, RecordedCamera, StaticObject, Toy
from sim_assets.rendering.camera import look_at

LENS = CameraIntrinsics(80, 60, 75.0, 75.0, 39.5, 29.5)


def ball(release=0.0, height=0.5):
    return Toy("ball", 0.02, np.array([0.0, 0.0, height]), release, (1.0, 0.0, 0.0))


def test_a_ball_falls_at_g_from_its_release_and_rests_on_the_support():
    world = DropWorld([], [ball(), ball(0.2, 1.0)], SupportPlane(), np.eye(4), [])
    world.advance(0.2)
    fallen, waiting = 0.5 - world.positions()[0, 2], world.positions()[1, 2]
    assert fallen == pytest.approx(0.5 * 9.81 * 0.2**2, rel=0.01) and waiting == pytest.approx(1.0)
    world.advance(2.5)
    assert world.positions()[0, 2] == pytest.approx(0.02, abs=2e-3) and world.speeds()[0] < 0.2


def test_gravity_follows_the_normal_of_the_support():
    normal = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    T = np.eye(4)
    T[:3, :3] = [[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]]
    world = DropWorld([], [ball()], SupportPlane(normal, 0.0), T, [])
    world.advance(0.1)
    np.testing.assert_allclose(
        world.positions()[0] - (0, 0, 0.5), -0.5 * 9.81 * 0.1**2 * normal, rtol=0.03, atol=1e-4
    )


def test_a_camera_sees_the_ball_at_its_depth_and_can_leave_it_out():
    camera = RecordedCamera(LENS, look_at(np.array([0.5, 0.0, 0.5]), np.array([0.0, 0.0, 0.5])))
    world = DropWorld([], [ball()], SupportPlane(), np.eye(4), [camera])
    image = world.render(0)
    assert image.toys[29:31, 39:41].all() and image.depth[30, 40] == pytest.approx(0.48, abs=2e-3)
    red = image.color[30, 40].astype(int)
    assert red[0] > red[1]
    assert (
        not world.render(0, toys=False).toys[30, 40] or (world.render(0, toys=False).color[30, 40] > 0).all()
    )
    world.close()


@pytest.mark.parametrize("lowest", [0.0, 0.05, 0.1])
def test_toys_land_on_objects_and_on_clutter(lowest):
    """A box 0.2 m high under the first die; clutter that is flat, or has a step, under the second."""
    box = trimesh.creation.box((0.1, 0.1, 0.2)).apply_translation((0, 0, 0.1))
    T = np.eye(4)
    T[:3, 3] = (0.3, 0.0, 0.0)
    block = StaticObject("block", box, [np.asarray(box.vertices)], T)
    heights = np.full((11, 11), 0.1)
    heights[0] = lowest
    field = HeightField(heights, np.eye(4), 0.02)
    toys = [
        Toy("die", 0.02, np.array([0.3, 0.0, 0.25]), 0.0, (1, 0, 0)),
        Toy("die", 0.02, np.array([0.0, 0.0, 0.15]), 0.0, (0, 1, 0)),
    ]
    world = DropWorld([block], toys, SupportPlane(), np.eye(4), [], field)
    world.advance(1.0)
    np.testing.assert_allclose(world.positions()[:, 2], (0.22, 0.12), atol=3e-3)


def test_toys_weigh_700_kilograms_per_cubic_metre():
    world = DropWorld([], [Toy("die", 0.02, np.zeros(3), 1.0, (1, 0, 0))], SupportPlane(), np.eye(4), [])
    assert world._model.body("toy0").mass[0] == pytest.approx(700 * 0.04**3)


def test_principal_point_of_the_recorded_camera():
    """A ball on the optical axis appears at the principal point, not at the image centre."""
    lens = CameraIntrinsics(80, 60, 75.0, 75.0, 49.5, 22.5)
    camera = RecordedCamera(lens, look_at(np.array([0.5, 0.0, 0.5]), np.array([0.0, 0.0, 0.5])))
    world = DropWorld([], [ball()], SupportPlane(), np.eye(4), [camera])
    v, u = np.nonzero(world.render(0).toys)
    world.close()
    np.testing.assert_allclose((u.mean(), v.mean()), (49.5, 22.5), atol=0.6)
