from dataclasses import replace

import numpy as np
import pytest

from manipulation import antipodal_grasps as module
from manipulation.antipodal_grasps import MIN_ELEVATION, _Surface, antipodal_grasps, antipodal_pairs
from manipulation.grasp_config import GraspConfig
from manipulation.hand_collision import HandBoxes
from manipulation.standing import to_standing
from perception.geometry import pose_from_yaw
from perception.types import TriangleMesh

UP, X = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(radius=0.03, height=0.1)))


@pytest.fixture(scope="module")
def cup(shapes):
    return to_standing(shapes.estimate(1, "mug", shapes.cup(radius=0.045, wall=0.004)))


@pytest.fixture(scope="module")
def lying_grasps_of_can(can):
    return antipodal_grasps(can, (X, UP)).grasps


def test_pairs_of_a_cylinder_are_on_diameters_or_on_its_ends(can):
    pairs = antipodal_pairs(_Surface.of(TriangleMesh(can.vertices, can.faces)))
    inner = [p for p in pairs if 0.015 < p.middle[2] < 0.085]
    across = [p for p in inner if abs(p.closing[2]) < 0.3]
    assert len(across) > 20
    for pair in across:
        assert np.linalg.norm(pair.middle[:2]) < 0.006
        assert pair.width == pytest.approx(0.06, abs=0.003)
    assert all(p.width == pytest.approx(0.1, abs=0.003) for p in inner if abs(p.closing[2]) > 0.95)


def test_pairs_across_a_wall_have_its_thickness(cup):
    pairs = antipodal_pairs(_Surface.of(TriangleMesh(cup.vertices, cup.faces), cup.top - 0.02))
    walls = [p for p in pairs if p.width < 0.02 and 0.015 < p.middle[2] < 0.085]
    assert walls
    for pair in walls:
        outward = np.array([*pair.middle[:2], 0.0]) / np.linalg.norm(pair.middle[:2])
        assert abs(pair.closing @ outward) > 0.9
        assert pair.width == pytest.approx(0.004, abs=0.001)


def test_the_hand_is_above_both_planes_and_points_between_them(can, lying_grasps_of_can):
    assert lying_grasps_of_can
    config = GraspConfig()
    for grasp in lying_grasps_of_can:
        assert min(grasp.away @ X, grasp.away @ UP) >= np.sin(MIN_ELEVATION) - 1e-9
        np.testing.assert_allclose(grasp.away, -grasp.T_stand_tcp[:3, 2], atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(grasp.T_stand_tcp[:3, :3]), 1.0)
        boxes = HandBoxes.of(config.gripper, grasp.opening, 0.1)
        assert boxes.lowest(grasp.T_stand_tcp) > config.fingertip_clearance
        assert grasp.held_width < grasp.opening <= config.gripper.max_width


def test_the_open_hand_does_not_meet_the_object(can, lying_grasps_of_can):
    on_axis = np.stack([np.zeros(50), np.zeros(50), np.linspace(0, 0.1, 50)], axis=1)
    angle = np.linspace(0, 2 * np.pi, 60)
    side = np.stack([0.03 * np.cos(angle), 0.03 * np.sin(angle), np.full(60, 0.05)], axis=1)
    for grasp in lying_grasps_of_can:
        T = grasp.T_stand_tcp
        boxes = HandBoxes.of(GraspConfig().gripper, grasp.opening, 0.1)
        points = (np.concatenate([on_axis, side]) - T[:3, 3]) @ T[:3, :3]
        assert not boxes.contain(points, -0.002)


def test_a_cup_too_wide_for_the_hand_is_held_by_its_wall(cup):
    found = antipodal_grasps(cup, (X, UP))
    assert found.grasps and all(grasp.held_width < 0.01 for grasp in found.grasps)
    assert found.rejected["too wide for 0.08 m"] > 0


def test_a_cup_on_its_side_is_held_at_several_places_of_its_rim(cup):
    grasps = antipodal_grasps(cup, (X, UP)).grasps
    beside = {
        np.sign(grasp.T_stand_tcp[1, 3]) for grasp in grasps if cup.top - grasp.T_stand_tcp[2, 3] < 0.02
    }
    assert beside == {-1, 1} and len(grasps) >= 12


def test_no_hand_is_above_the_top_and_the_bottom_of_an_object(can):
    found = antipodal_grasps(can, (-UP, UP))
    assert not found.grasps and found.rejected["without an approach from above"] > 0


def test_a_solid_wider_than_the_hand_has_no_grasp(shapes):
    wide = to_standing(shapes.estimate(1, "can", shapes.can(radius=0.045, height=0.12)))
    assert not antipodal_grasps(wide, (X, UP)).grasps


def test_grasps_repeat(can, lying_grasps_of_can):
    again = antipodal_grasps(can, (X, UP)).grasps
    np.testing.assert_array_equal(again[0].T_stand_tcp, lying_grasps_of_can[0].T_stand_tcp)


def test_each_grasp_is_offered_with_both_turns_of_the_hand(lying_grasps_of_can):
    """What is mounted on one side of the hand is free with one of them."""
    grasps = lying_grasps_of_can
    assert len(grasps) % 2 == 0
    for grasp, turned in zip(grasps[::2], grasps[1::2]):
        assert turned.T_stand_tcp[:3, :2] == pytest.approx(-grasp.T_stand_tcp[:3, :2])
        assert turned.T_stand_tcp[:3, 2:] == pytest.approx(grasp.T_stand_tcp[:3, 2:])
        assert turned.score == grasp.score


def test_opposite_places_are_looked_for_once_for_each_mesh(shapes, monkeypatch):
    looked = []
    search = module.antipodal_pairs
    monkeypatch.setattr(module, "antipodal_pairs", lambda surface: looked.append(1) or search(surface))
    first, second = (to_standing(shapes.estimate(1, "can", shapes.can(radius=0.031))) for _ in range(2))
    poses = [replace(first, T_world_stand=pose_from_yaw(yaw, np.zeros(3))) for yaw in (0.0, 1.0)]
    found = [antipodal_grasps(item, ups).grasps for item in poses for ups in ((UP,), (X, UP))]
    assert len(looked) == 1
    assert len(found[0]) != len(found[1]), "planes count all the same"
    antipodal_grasps(second, (UP,))
    assert len(looked) == 2, "an equal mesh of another object is another one"
