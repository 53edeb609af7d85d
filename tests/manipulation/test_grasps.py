from dataclasses import replace

import numpy as np
import pytest
import trimesh

from manipulation.cross_sections import extent, fit_circle
from manipulation.errors import PlanningError
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.planner import plan_pack
from manipulation.robot import GripperGeometry
from manipulation.standing import split_handle, to_standing
from manipulation.types import Box
from perception.mesh_sections import cross_section, radial_hits
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

CONFIG = GraspConfig()


def standing(shapes, category, mesh, **where):
    return to_standing(shapes.estimate(1, category, mesh, **where))


def fingers(grasp):
    """Middle of both pads' faces before closing, in the stand frame."""
    T = grasp.T_stand_tcp
    return T[:3, 3] + 0.5 * grasp.opening * T[:3, 1], T[:3, 3] - 0.5 * grasp.opening * T[:3, 1]


def test_section_of_a_cup_has_two_walls(shapes):
    mesh = shapes.cup(radius=0.04, wall=0.004)
    cut = cross_section(np.asarray(mesh.vertices), np.asarray(mesh.faces), 0.05)
    hits = radial_hits(cut, np.zeros(2), 0.3)
    assert hits == pytest.approx([0.036, 0.040], abs=2e-4)
    assert extent(cut, 0.0).width == pytest.approx(0.08, abs=2e-4)
    assert cross_section(np.asarray(mesh.vertices), np.asarray(mesh.faces), 1.0).shape == (0, 2, 2)
    assert extent(np.zeros((0, 2, 2)), 0.0) is None
    assert len(radial_hits(np.zeros((0, 2, 2)), np.zeros(2), 0.0)) == 0


def test_circle_fit_is_exact_on_a_circle():
    angle = np.linspace(0, 2, 9)
    center, radius = fit_circle(np.stack([0.3 + 2 * np.cos(angle), -0.1 + 2 * np.sin(angle)], axis=1))
    assert center == pytest.approx([0.3, -0.1]) and radius == pytest.approx(2)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_mugs_stand_frame_is_below_the_body_not_the_bounding_box(shapes, yaw):
    item = standing(shapes, "mug", shapes.mug(), x=0.5, y=-0.2, yaw=yaw, lift=0.004)
    assert item.T_world_stand[:3, 3] == pytest.approx([0.5, -0.2, 0], abs=1e-3)
    assert np.arctan2(item.T_world_stand[1, 0], item.T_world_stand[0, 0]) == pytest.approx(yaw)
    assert item.vertices[:, 0].max() == pytest.approx(0.065, abs=1e-3)
    assert item.top == pytest.approx(0.099, abs=1e-3)  # seen 4 mm too high: the rim is where it was seen
    body, handle = split_handle(item.vertices, "mug")
    assert np.abs(body).max(axis=0)[0] < 0.041 and handle[:, 0].max() > 0.06


def test_stand_frame_of_a_flat_bottle_points_along_its_narrow_side(shapes):
    item = standing(shapes, "bottle", shapes.flat_bottle(), yaw=0.4)
    assert not item.is_round
    assert np.ptp(item.vertices, axis=0) == pytest.approx([0.05, 0.09, 0.2], abs=1e-6)
    turned = standing(shapes, "bottle", shapes.flat_bottle(narrow=0.09, wide=0.05), yaw=0.4)
    assert np.ptp(turned.vertices, axis=0) == pytest.approx([0.05, 0.09, 0.2], abs=1e-6)


def test_support_plane_sets_the_height(shapes):
    estimate = shapes.estimate(1, "can", shapes.can(), lift=0.1)
    item = to_standing(estimate, SupportPlane(offset=0.1))
    assert item.T_world_stand[2, 3] == pytest.approx(0.1)
    assert item.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def test_lying_and_empty_objects_cannot_be_handled(shapes):
    upright = shapes.estimate(7, "bottle", shapes.bottle())
    T = np.array(upright.T_world_object)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    lying = ObjectEstimate(7, "bottle", np.zeros(16), T, np.ones(3), upright.mesh)
    with pytest.raises(PlanningError, match=r"bottle_7 lies on its side.*90 degrees"):
        to_standing(lying)
    nothing = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    empty = ObjectEstimate(7, "can", np.zeros(16), np.eye(4), np.ones(3), nothing)
    with pytest.raises(PlanningError, match="can_7 has an empty mesh"):
        to_standing(empty)


def test_hand_follows_the_wall_of_a_low_bowl_with_an_uneven_rim(shapes):
    mesh = shapes.bowl(radius=0.065, height=0.038, wall=0.006, slope=0.45)
    vertices = np.array(mesh.vertices)
    dented = (vertices[:, 2] > 0.03) & (np.sin(3 * np.arctan2(vertices[:, 1], vertices[:, 0])) > 0)
    vertices[dented, 2] -= 0.002
    grasps = grasp_candidates(
        standing(shapes, "bowl", trimesh.Trimesh(vertices, mesh.faces, process=False))
    ).grasps
    tilts = np.array([np.arccos(-grasp.T_stand_tcp[2, 2]) for grasp in grasps])
    assert len(grasps) > 20
    assert tilts == pytest.approx(0.45, abs=np.deg2rad(6))


def test_mug_rim_is_straddled_away_from_the_handle(shapes):
    item = standing(shapes, "mug", shapes.mug(radius=0.04, height=0.095, wall=0.004), yaw=0.7)
    found = grasp_candidates(item, CONFIG)
    assert found.rejected["at the handle"] == 7
    assert found.n_candidates == len(found.grasps) + 7
    for grasp in found.grasps:
        assert grasp.kind == "rim" and abs(grasp.azimuth) > np.deg2rad(50)
        T = grasp.T_stand_tcp
        assert np.linalg.norm(T[:2, 3]) == pytest.approx(0.038, abs=1e-3)
        assert item.top - T[2, 3] == pytest.approx(CONFIG.mug_depth, abs=1e-4)
        assert T[:3, 2] == pytest.approx([0, 0, -1], abs=1e-6)
        radii = sorted(np.linalg.norm(finger[:2]) for finger in fingers(grasp))
        assert radii[0] < 0.036 - 0.010 and radii[1] > 0.040 + 0.010
        low, high = grasp.closed_width
        assert low < grasp.held_width < high
        assert grasp.held_width == pytest.approx(0.004, abs=3e-4)
        assert grasp.release_opening == pytest.approx(0.004 + 0.009, abs=3e-4)


def test_every_rim_grasp_comes_with_its_half_turn(shapes):
    grasps = grasp_candidates(standing(shapes, "bowl", shapes.bowl()), CONFIG).grasps
    for grasp in grasps:
        turned = grasp.T_stand_tcp @ np.diag([-1.0, -1, 1, 1])
        assert any(np.allclose(turned, other.T_stand_tcp, atol=1e-9) for other in grasps)


@pytest.mark.parametrize("slope", np.deg2rad([0, 10, 20]))
def test_hand_leans_with_the_bowls_wall(shapes, slope):
    item = standing(shapes, "bowl", shapes.bowl(radius=0.075, height=0.06, slope=slope))
    grasps = grasp_candidates(item, CONFIG).grasps
    assert len(grasps) == 2 * CONFIG.n_azimuths
    for grasp in grasps:
        T = grasp.T_stand_tcp
        outward = np.array([np.cos(grasp.azimuth), np.sin(grasp.azimuth), 0])
        assert np.arctan2(-T[:3, 2] @ outward, -T[2, 2]) == pytest.approx(slope, abs=np.deg2rad(1.5))
        # The TCP is in the middle of the wall at the height of the pads.
        middle = 0.075 - (0.06 - T[2, 3]) * np.tan(slope) - 0.002 / np.cos(slope)
        assert T[:3, 3] @ outward == pytest.approx(middle, abs=1e-3)
        assert T[2, 3] - CONFIG.gripper.tip > CONFIG.fingertip_clearance


def test_the_hand_leaves_past_a_wall_that_bends_upright(shapes):
    """A round bowl leans where the pads hold it and is upright at its rim: the hand leaves in between."""
    angle = np.linspace(0.0, np.pi / 2, 40)
    outer = np.stack([0.08 * np.sin(angle), 0.06 * (1 - np.cos(angle))], axis=1)
    inner = outer[::-1] * (0.95, 0.93) + (0.0, 0.0042)
    mesh = trimesh.creation.revolve(np.concatenate([outer, inner]), sections=64)
    grasps = grasp_candidates(standing(shapes, "bowl", mesh)).grasps
    assert len(grasps) == 2 * CONFIG.n_azimuths
    for grasp in grasps:
        tilt, leaving = np.arccos(-grasp.T_stand_tcp[2, 2]), np.arccos(grasp.away[2])
        assert np.deg2rad(2) < leaving < tilt - np.deg2rad(2)


def test_low_bowls_are_held_shallower_and_flatter(shapes):
    item = standing(shapes, "bowl", shapes.bowl(radius=0.05, height=0.028, slope=np.deg2rad(20)))
    grasps = grasp_candidates(item, CONFIG).grasps
    assert grasps
    for grasp in grasps:
        tilt = np.arccos(-grasp.T_stand_tcp[2, 2])
        lowest = grasp.T_stand_tcp[2, 3] - CONFIG.gripper.tip * np.cos(tilt) - 0.026 * np.sin(tilt)
        assert lowest >= CONFIG.fingertip_clearance - 1e-6
    none = grasp_candidates(standing(shapes, "bowl", shapes.bowl(radius=0.05, height=0.018)), CONFIG)
    assert not none.grasps and none.rejected["too low"] == CONFIG.n_azimuths


def test_shallow_cavity_is_grasped_less_deep(shapes):
    """A thick floor 20 mm below the rim: the fingertip, 9.5 mm beyond the TCP, stays above it."""
    item = standing(shapes, "bowl", shapes.cup(radius=0.05, height=0.045, wall=0.004, base=0.025))
    for grasp in grasp_candidates(item, CONFIG).grasps:
        assert grasp.T_stand_tcp[2, 3] - CONFIG.gripper.tip > 0.025
        assert grasp.depth < CONFIG.bowl_depth


def test_can_is_held_around_its_axis_from_above(shapes):
    item = standing(shapes, "can", shapes.can(radius=0.033, height=0.12))
    for grasp in grasp_candidates(item, CONFIG).grasps:
        assert grasp.kind == "top" and 0.012 <= grasp.depth <= 0.032
        assert grasp.T_stand_tcp[:2, 3] == pytest.approx([0, 0], abs=3e-4)
        assert grasp.T_stand_tcp[2, 3] == pytest.approx(0.12 - grasp.depth)
        assert grasp.held_width == pytest.approx(0.066, abs=2e-4)
        low, high = grasp.closed_width  # a body a fifth wider than it looked is held all the same
        assert low < 0.066 and 0.074 < high < grasp.opening


def test_bottle_is_held_at_its_neck(shapes):
    item = standing(shapes, "bottle", shapes.bottle(radius=0.045, height=0.22, neck=0.014))
    best = grasp_candidates(item, CONFIG).grasps[0]
    assert best.T_stand_tcp[2, 3] > 0.72 * 0.22 + CONFIG.gripper.tip
    assert 0.028 < best.opening < 0.06


def test_flat_bottle_is_held_over_its_narrow_side(shapes):
    item = standing(shapes, "bottle", shapes.flat_bottle(narrow=0.05, wide=0.09), yaw=0.3)
    found = grasp_candidates(item, CONFIG)
    assert found.grasps and any(reason.startswith("too wide") for reason in found.rejected)
    assert abs(found.grasps[0].T_stand_tcp[0, 1]) > np.cos(np.deg2rad(20))


def test_open_tumbler_too_wide_for_the_hand_is_held_by_its_rim(shapes):
    found = grasp_candidates(standing(shapes, "bottle", shapes.cup(radius=0.045, height=0.15)), CONFIG)
    assert found.grasps and {grasp.kind for grasp in found.grasps} == {"rim"}


def test_mug_whose_cavity_was_not_reconstructed_gets_a_default_wall(shapes):
    item = standing(shapes, "bowl", shapes.can(radius=0.06, height=0.07))
    grasp = grasp_candidates(item, CONFIG).grasps[0]
    assert np.linalg.norm(grasp.T_stand_tcp[:2, 3]) == pytest.approx(0.06 - CONFIG.default_wall / 2, abs=5e-4)


def test_object_without_grasp_says_why(shapes):
    found = grasp_candidates(standing(shapes, "can", shapes.can(radius=0.05)), CONFIG)
    assert found.failure_message("can_1") == (
        "No grasp for can_1: of 60 candidates, 60 too wide for 0.08 m; exclude it or use a wider gripper"
    )


def test_grasps_are_planned_for_the_arms_own_gripper(arm, shapes):
    """A can too wide for the usual hand is taken by an arm whose hand opens wider."""
    wide = [shapes.estimate(1, "can", shapes.can(radius=0.044))]
    with pytest.raises(PlanningError, match=r"too wide for 0\.08 m"):
        plan_pack(wide, Box(), arm)
    plan = plan_pack(wide, Box(), replace(arm, gripper=GripperGeometry(max_width=0.1)))
    assert [placement.name for placement in plan.placements] == ["can_1"] and not plan.left_out
