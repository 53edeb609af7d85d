"""Support planes fitted to rendered planes of known parameters."""

import numpy as np
import pytest

from perception.errors import InvalidInputError, PerceptionError
from perception.support_plane import fit_support_plane
from perception.types import CameraIntrinsics, RgbdFrame

K = CameraIntrinsics(160, 120, 145.0, 145.0, 79.5, 59.5)


def plane_frame(normal, offset, T=None, noise=0.0, clutter=0.0, seed=0):
    """Return a depth image of the plane ``normal . p_camera = offset``; a share of columns is 5 cm nearer."""
    v, u = np.mgrid[: K.height, : K.width]
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones_like(u)], -1)
    depth = offset / (rays @ normal)
    depth[:, : int(clutter * K.width)] -= 0.05
    depth = np.where(depth > 0, depth, 0.0)
    depth += noise * np.random.default_rng(seed).normal(size=depth.shape) * (depth > 0)
    return RgbdFrame(0.0, np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.float32), K, T)


def tilted(degrees):
    return np.array([0.0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])


def angle(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0])
def test_without_a_pose_the_plane_is_in_the_camera_frame(degrees):
    normal = tilted(degrees)
    plane = fit_support_plane([plane_frame(normal, 0.6)])
    assert angle(plane.normal, -normal) < 0.02  # towards the camera
    assert plane.offset == pytest.approx(-0.6, abs=1e-4)


def test_noise_and_clutter_change_the_offset_by_less_than_a_millimetre():
    normal = tilted(30)
    plane = fit_support_plane([plane_frame(normal, 0.6, noise=0.002, clutter=0.4)])
    assert angle(plane.normal, -normal) < 0.3
    assert plane.offset == pytest.approx(-0.6, abs=1e-3)


def test_several_posed_views_are_fitted_in_the_world_frame(scenes):
    solids = [scenes.Solid(0.45, -0.2, 0.1, radius=0.04), scenes.Solid(0.5, 0.2, 0.006, half=(0.18, 0.15))]
    poses = [scenes.orbit((0.48, -0.2, 0.05), 0.5, e, a) for e, a in ((90, 0), (60, 90), (45, 200))]
    plane = fit_support_plane([scenes.render(solids, T, noise=0.002).frame for T in poses])
    assert angle(plane.normal, np.array([0.0, 0.0, 1.0])) < 0.2
    assert abs(plane.offset) < 5e-4


def test_a_wall_is_not_fitted_as_the_support_plane(scenes):
    wall = scenes.Solid(0.5, 0.3, 2.0, half=(2.0, 0.01))  # fills over half of the image
    frame = scenes.render([wall], scenes.look_at((0.5, -0.5, 0.5), (0.5, 0.3, 0.2))).frame
    plane = fit_support_plane([frame])
    assert angle(plane.normal, np.array([0.0, 0.0, 1.0])) < 0.1


def test_the_fit_is_deterministic_for_a_seed():
    frame = plane_frame(tilted(10), 0.5, noise=0.002)
    first, second = fit_support_plane([frame], seed=3), fit_support_plane([frame], seed=3)
    assert np.array_equal(first.normal, second.normal) and first.offset == second.offset


def test_depth_without_a_plane_is_an_error_with_a_remedy():
    depth = np.random.default_rng(0).uniform(0.3, 2.5, (K.height, K.width)).astype(np.float32)
    frame = RgbdFrame(0.0, np.zeros((K.height, K.width, 3), np.uint8), depth, K)
    with pytest.raises(PerceptionError, match=r"No support plane: .* show more of the table"):
        fit_support_plane([frame])


def test_empty_depth_is_an_error():
    frame = RgbdFrame(0.0, np.zeros((120, 160, 3), np.uint8), np.zeros((120, 160), np.float32), K)
    with pytest.raises(PerceptionError, match="only 0 depth points"):
        fit_support_plane([frame])


def test_several_frames_need_poses():
    frame = plane_frame(tilted(0), 0.6)
    with pytest.raises(InvalidInputError, match="needs T_world_camera of each"):
        fit_support_plane([frame, frame])
    with pytest.raises(InvalidInputError, match="at least one"):
        fit_support_plane([])
