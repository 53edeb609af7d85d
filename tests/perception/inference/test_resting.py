"""Initial resting poses of known solids, and which poses are at rest."""

import numpy as np
import pytest
import trimesh

from perception.errors import InvalidInputError
from perception.geometry import so3_exp, upright_rotation
from perception.inference.initialise import initial_poses
from perception.inference.optimisation import LYING_BEAM
from perception.inference.resting import (
    ALTERNATIVES,
    initial_resting_poses,
    principal_axis,
    resting_pose,
    rests_stably,
    tilt_error,
)
from perception.rendering.pose import ObjectPose
from perception.types import SupportPlane, TriangleMesh
from tests.perception.inference.conftest import Table

PLANE = SupportPlane()
RADIUS, HALF = 0.55 * 0.05, 0.75 * 0.05  # of the cylinder that code 0 makes at scale 0.05


def lying(decoder, direction: float, category: str = "can") -> Table:
    """A cylinder on its side whose axis has a direction in the plane."""
    z = np.array([np.cos(direction), np.sin(direction), 0.0])
    rotation = np.stack([[0.0, 0.0, 1.0], np.cross(z, [0.0, 0.0, 1.0]), z], axis=1)
    return Table(
        decoder, category, np.zeros(16), ObjectPose(rotation, np.array([0.4, -0.1, RADIUS]), np.full(3, 0.05))
    )


def solid(mesh: trimesh.Trimesh, rotation: np.ndarray) -> TriangleMesh:
    """The mesh turned, with its lowest point on the plane."""
    vertices = np.asarray(mesh.vertices) @ rotation.T
    return TriangleMesh(vertices - (0, 0, vertices[:, 2].min()), np.asarray(mesh.faces))


def about_y(degrees: float) -> np.ndarray:
    return so3_exp(np.array([0.0, np.deg2rad(degrees), 0.0]))


def test_principal_axis_of_a_rectangle() -> None:
    """Standard deviations of a rectangle are proportional to its sides."""
    x, y = np.meshgrid(np.linspace(-3, 3, 61), np.linspace(-1, 1, 21))
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    axis, ratio = principal_axis(np.stack([x.ravel(), y.ravel()], axis=1) @ turn.T)
    assert abs(axis @ turn[:, 0]) == pytest.approx(1.0)
    assert ratio == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize("azimuths", [(0.3,), (1.5,), (0.0, 2.0, 4.0)])
@pytest.mark.parametrize("direction", [0.0, 0.8, 2.2])
def test_axis_centre_and_size_of_a_lying_cylinder(decoder, azimuths, direction) -> None:
    table = lying(decoder, direction)
    poses, measures = initial_resting_poses(table.observations(azimuths), "can", PLANE, "lying")
    axes = np.array([pose.rotation[:, 2] for pose in poses])
    assert np.abs(axes @ table.pose.rotation[:, 2]).max() > np.cos(np.deg2rad(6))
    np.testing.assert_allclose(axes[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(poses[0].translation, table.pose.translation, atol=0.006)
    np.testing.assert_allclose(1.8 * poses[0].scale, 2 * HALF, rtol=0.1)
    assert measures.height == pytest.approx(2 * RADIUS, abs=0.004)


def test_bottles_lie_either_way_round_with_the_first_axis_up_or_level(decoder) -> None:
    poses, _ = initial_resting_poses(lying(decoder, 0.5).observations((1.0, 3.0)), "bottle", PLANE, "lying")
    first, *others = (pose.rotation for pose in poses)
    assert any(R[:, 2] @ first[:, 2] < -0.99 for R in others)
    assert {round(abs(float(R[2, 0]))) for R in (first, *others)} == {0, 1}
    for R in (first, *others):
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)
    assert len(poses) <= LYING_BEAM, "the coarse stage rules out no direction"


@pytest.mark.parametrize("azimuth", [0.2, 1.4, 3.9])
def test_a_lying_object_starts_in_the_direction_that_is_given(decoder, azimuth) -> None:
    """Whatever the measured points suggest: a cone is no strip along its axis."""
    seen = lying(decoder, 0.5).observations((1.0, 3.0))
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    poses, _ = initial_resting_poses(seen, "bottle", PLANE, "lying", level + np.array([0.0, 0.0, 0.2]))
    np.testing.assert_allclose([pose.rotation[:, 2] for pose in poses], [level] * len(poses), atol=1e-12)
    rolls = {tuple(pose.rotation[:, 0].round(6)) for pose in poses}
    assert len(rolls) == len(poses) == 2


def test_an_upside_down_mug_has_its_axis_down_and_all_yaws(make_table) -> None:
    seen = make_table("mug", (), yaw=1.0).observations((0.0,))
    upright, _ = initial_poses(seen, "mug", PLANE)
    poses, _ = initial_resting_poses(seen, "mug", PLANE, "upside-down")
    np.testing.assert_allclose([pose.rotation[:, 2] for pose in poses], [[0, 0, -1]] * len(poses), atol=1e-12)
    np.testing.assert_allclose(poses[0].translation, upright[0].translation)
    yaws = sorted(np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0]) % (2 * np.pi) for pose in poses)
    np.testing.assert_allclose(np.diff(yaws), 2 * np.pi / len(poses))


def test_upright_poses_are_those_of_the_upright_initialisation(make_table) -> None:
    seen = make_table("can", (), yaw=0.0).observations((0.0, 2.0))
    (expected,), _ = initial_poses(seen, "can", PLANE)
    (pose,), _ = initial_resting_poses(seen, "can", PLANE)
    np.testing.assert_array_equal(pose.T_world_object, expected.T_world_object)
    np.testing.assert_array_equal(pose.scale, expected.scale)


def test_an_object_below_the_plane_cannot_lie_on_it(decoder) -> None:
    with pytest.raises(InvalidInputError, match="measured points"):
        initial_resting_poses(
            lying(decoder, 0.0).observations((0.0,)), "can", SupportPlane(offset=1.0), "lying"
        )


@pytest.mark.parametrize(
    ("angle", "pose"), [(10, "upright"), (80, "lying"), (100, "lying"), (170, "upside-down")]
)
def test_nearest_resting_pose_and_the_angle_to_it(angle, pose) -> None:
    plane = SupportPlane(normal=about_y(20)[:, 2])
    rotation = about_y(20 + angle)
    assert resting_pose(rotation, plane) == pose
    assert tilt_error(rotation, plane, pose) == pytest.approx(np.deg2rad(10))
    assert tilt_error(rotation, plane, "upright") == pytest.approx(np.deg2rad(angle))


@pytest.mark.parametrize(("angle", "stable"), [(0, True), (90, True), (180, True), (45, False), (60, False)])
def test_a_cylinder_rests_on_its_ends_and_on_its_side(angle, stable) -> None:
    cylinder = trimesh.creation.cylinder(0.03, 0.12, sections=64)
    assert rests_stably(solid(cylinder, about_y(angle)), PLANE) == stable


def test_a_body_with_its_mass_beside_its_foot_topples() -> None:
    foot, arm = trimesh.creation.box((0.04, 0.04, 0.02)), trimesh.creation.box((0.2, 0.04, 0.04))
    arm.apply_translation((0.08, 0, 0.03))
    together = trimesh.util.concatenate([foot, arm])
    assert not rests_stably(solid(together, np.eye(3)), PLANE)
    assert rests_stably(solid(foot, np.eye(3)), PLANE)


def test_bowls_and_cans_have_the_poses_that_can_be_told_from_upright() -> None:
    assert ALTERNATIVES["bowl"] == ("upside-down",) and ALTERNATIVES["can"] == ("lying",)
    assert upright_rotation(PLANE.normal, 0.0)[2, 2] == 1.0
