"""Dropped toys: free fall, release times, slanted supports, rendering."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics, SupportPlane
from sim_assets.cell.drop_world import DropWorld, RecordedCamera, Toy
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
