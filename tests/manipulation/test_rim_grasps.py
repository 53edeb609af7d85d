from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from manipulation.cross_sections import CrossSectionCache
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.rim_grasps import _slope, _Slopes, _turn_and_bend, rim_grasps, wall_at
from manipulation.standing import to_standing

CONFIG = GraspConfig()


def standing(shapes, category, mesh, **where):
    return to_standing(shapes.estimate(1, category, mesh, **where))


def fingers(grasp):
    """Middle of both pads' faces before closing, in the stand frame."""
    T = grasp.T_stand_tcp
    return T[:3, 3] + 0.5 * grasp.opening * T[:3, 1], T[:3, 3] - 0.5 * grasp.opening * T[:3, 1]


def test_tilt_follows_the_wall_of_a_low_bowl_with_an_uneven_rim(shapes):
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


def test_mug_rim_grasps_avoid_the_handle_and_straddle_the_wall(shapes):
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


def test_every_rim_grasp_is_generated_with_both_finger_orders(shapes):
    grasps = grasp_candidates(standing(shapes, "bowl", shapes.bowl()), CONFIG).grasps
    for grasp in grasps:
        turned = grasp.T_stand_tcp @ np.diag([-1.0, -1, 1, 1])
        assert any(np.allclose(turned, other.T_stand_tcp, atol=1e-9) for other in grasps)


@pytest.mark.parametrize("slope", np.deg2rad([0, 10, 20]))
def test_tilt_equals_the_slope_of_the_wall(shapes, slope):
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


def test_the_retreat_follows_a_wall_that_becomes_steeper_towards_the_rim(shapes):
    """A round bowl leans where the pads hold it and is upright at its rim: the hand leaves in between."""
    angle = np.linspace(0.0, np.pi / 2, 40)
    outer = np.stack([0.08 * np.sin(angle), 0.06 * (1 - np.cos(angle))], axis=1)
    inner = outer[::-1] * (0.95, 0.93) + (0.0, 0.0042)
    mesh = trimesh.creation.revolve(np.concatenate([outer, inner]), sections=64)
    grasps = grasp_candidates(standing(shapes, "bowl", mesh)).grasps
    assert len(grasps) == 2 * CONFIG.n_azimuths
    for grasp in grasps:
        tilt, retreat = np.arccos(-grasp.T_stand_tcp[2, 2]), np.arccos(grasp.away[2])
        assert np.deg2rad(2) < retreat < tilt - np.deg2rad(2)


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


def test_mug_whose_cavity_was_not_reconstructed_gets_a_default_wall(shapes):
    item = standing(shapes, "bowl", shapes.can(radius=0.06, height=0.07))
    grasp = grasp_candidates(item, CONFIG).grasps[0]
    assert np.linalg.norm(grasp.T_stand_tcp[:2, 3]) == pytest.approx(0.06 - CONFIG.default_wall / 2, abs=5e-4)


def test_the_handle_sector_is_excluded_for_mugs_only(shapes):
    """24 directions of 15 degrees: those within 50 degrees of the handle are excluded."""
    item = standing(shapes, "mug", shapes.cup(radius=0.04))
    azimuths = {round(np.rad2deg(grasp.azimuth)) for grasp in grasp_candidates(item).grasps}
    assert azimuths == {a for a in range(-180, 181, 15) if abs(a) >= 60} - {-180}
    bowl = standing(shapes, "bowl", shapes.cup(radius=0.04))
    assert len({round(grasp.azimuth, 6) for grasp in grasp_candidates(bowl).grasps}) == 24


def test_wall_at_measures_both_sides_and_the_cavity(shapes):
    item = standing(shapes, "bowl", shapes.cup(radius=0.04, wall=0.004))
    wall = wall_at(CrossSectionCache(item.vertices, item.faces), 0.05, 0.2, CONFIG)
    assert (wall.inner, wall.outer, wall.across) == pytest.approx((0.036, 0.040, 0.072), abs=3e-4)
    assert wall.thickness == pytest.approx(0.004, abs=1e-5) and wall.middle == pytest.approx(0.038, abs=2e-4)
    assert wall.hollow


def test_walls_thicker_than_the_limit_are_rejected(shapes):
    for thickness, allowed in ((0.019, True), (0.021, False)):
        item = standing(shapes, "bowl", shapes.cup(radius=0.06, wall=thickness))
        wall = wall_at(CrossSectionCache(item.vertices, item.faces), 0.05, 0.2, CONFIG)
        assert (wall is not None) == allowed
    assert grasp_candidates(item).rejected == {"too thick at the rim": CONFIG.n_azimuths}


def test_a_cavity_too_narrow_for_a_finger_is_rejected(shapes):
    """The inner finger is 18.5 mm thick and keeps 3 mm from the opposite wall."""
    narrow = standing(shapes, "bowl", shapes.cup(radius=0.017, wall=0.002))
    assert grasp_candidates(narrow).rejected == {"too narrow inside": CONFIG.n_azimuths}
    wide = standing(shapes, "bowl", shapes.cup(radius=0.022, wall=0.002))
    for grasp in grasp_candidates(wide).grasps:
        # cavity 40 mm: half opening = 0.040 - 0.0185 - 0.003 - 0.001, limited to 16 mm
        assert grasp.opening == pytest.approx(2 * 0.016, abs=1e-3)
    middle = standing(shapes, "bowl", shapes.cup(radius=0.0185, wall=0.002))
    half = 2 * 0.0165 - 0.0185 - 0.003 - 0.001
    assert grasp_candidates(middle).grasps[0].opening == pytest.approx(2 * half, abs=5e-4)


def test_grasps_whose_fingertip_meets_the_floor_come_last(shapes):
    """A cavity 13 mm deep: even a depth of 0.6 * 10 mm leaves no room for the 9.5 mm of the fingertip."""
    item = standing(shapes, "bowl", shapes.cup(radius=0.05, height=0.045, wall=0.004, base=0.032))
    grasps = rim_grasps(item, CrossSectionCache(item.vertices, item.faces), CONFIG, Counter())
    assert {round(grasp.depth, 4) for grasp in grasps} <= {0.006, 0.008, 0.01}
    assert max(grasp.score for grasp in grasps) <= 0.5 + 1e-9


def tapered(shapes, category="bowl", dent=0.0):
    """A vessel whose outer side leans by atan(0.2), its inner one vertical, with a dent at azimuth 0 [m]."""
    mesh = trimesh.creation.revolve(
        np.array([(0, 0), (0.06, 0), (0.072, 0.06), (0.055, 0.06), (0.055, 0.005), (0, 0.005)]), sections=48
    )
    vertices = np.array(mesh.vertices)
    rim = (np.abs(np.arctan2(vertices[:, 1], vertices[:, 0])) < 0.1) & (vertices[:, 2] > 0.05)
    vertices[rim, :2] *= 1 + dent / 0.06
    return standing(shapes, category, trimesh.Trimesh(vertices, mesh.faces, process=False))


def test_the_slope_of_a_wall_is_the_mean_of_both_sides(shapes):
    item = tapered(shapes)
    sections = CrossSectionCache(item.vertices, item.faces)
    assert _slope(sections, 0.06, 0.015, 0.5) == pytest.approx(0.5 * np.arctan(0.2), abs=0.01)
    solid = standing(shapes, "bowl", shapes.can(radius=0.03, height=0.06))
    assert _slope(CrossSectionCache(solid.vertices, solid.faces), 0.06, 0.015, 0.5) == pytest.approx(0.0)


def test_a_dent_changes_the_slope_of_a_mug_there_but_not_that_of_a_round_bowl(shapes):
    dented = _Slopes(item := tapered(shapes, dent=0.006), CrossSectionCache(item.vertices, item.faces))
    assert item.is_round
    expected = 0.5 * np.arctan(0.2)
    assert dented.at(0.06, 0.015, 0.0) == pytest.approx(expected, abs=0.01)
    mug = tapered(shapes, "mug", dent=0.006)
    dented = _Slopes(mug, CrossSectionCache(mug.vertices, mug.faces))
    assert not mug.is_round and dented.at(0.06, 0.015, 0.0) > expected + 0.05


def octagonal(shapes):
    """A bowl whose sides are those of an octagon, with the middle of one at azimuth 0."""
    round_bowl = shapes.bowl()
    vertices = np.array(round_bowl.vertices)
    azimuth = np.arctan2(vertices[:, 1], vertices[:, 0])
    off = (azimuth + np.pi / 8) % (np.pi / 4) - np.pi / 8  # from the middle of the nearest side
    vertices[:, :2] *= (np.cos(np.pi / 8) / np.cos(off))[:, None]
    return trimesh.Trimesh(vertices, round_bowl.faces, process=False)


def nearest_side(grasp):
    """Return the azimuth of the middle of the octagon's side that a grasp is at."""
    return np.round(grasp.azimuth / (np.pi / 4)) * np.pi / 4


def from_corner(grasp):
    """Return the angle between a grasp's azimuth and the nearest corner of the octagon."""
    return np.pi / 8 - abs(grasp.azimuth - nearest_side(grasp))


def turn_of_pads(grasp):
    """Return the angle between the pads and the octagon's side, for either order of the fingers."""
    closing = np.arctan2(*grasp.T_stand_tcp[[1, 0], 1])
    return abs((closing - nearest_side(grasp) + np.pi / 2) % np.pi - np.pi / 2)


def test_the_pads_meet_the_sides_of_a_polygonal_bowl_squarely(shapes):
    """Else they turn it when they close."""
    for grasp in grasp_candidates(standing(shapes, "bowl", octagonal(shapes)), CONFIG).grasps:
        if from_corner(grasp) * 0.075 > CONFIG.gripper.finger_half_width:
            assert turn_of_pads(grasp) < np.deg2rad(2.5)


def test_an_uneven_rim_does_not_hide_the_sides_of_a_polygonal_bowl(shapes):
    """Pads that hold the uppermost part alone are where the rim of a reconstruction ends here and there."""
    mesh = octagonal(shapes)
    rng, top = np.random.default_rng(0), mesh.vertices[:, 2].max()
    at_rim = mesh.vertices[:, 2] > top - 0.004
    mesh.vertices[at_rim, 2] -= rng.uniform(0.0, 0.003, at_rim.sum())
    item, config = standing(shapes, "bowl", mesh), CONFIG.shallow()
    found = rim_grasps(item, CrossSectionCache(item.vertices, item.faces), config, Counter())
    on_sides = [g for g in found if from_corner(g) * 0.075 > CONFIG.gripper.finger_half_width]
    assert len(on_sides) >= 16 and max(turn_of_pads(grasp) for grasp in on_sides) < np.deg2rad(4)


def test_corners_of_a_polygonal_bowl_come_last(shapes):
    item = standing(shapes, "bowl", octagonal(shapes))
    config = replace(CONFIG, n_azimuths=16)
    scores = {0: [], 1: []}
    for grasp in rim_grasps(item, CrossSectionCache(item.vertices, item.faces), config, Counter()):
        scores[round(grasp.azimuth / (np.pi / 8)) % 2].append(grasp.score)
    assert max(scores[1]) < min(scores[0]) - 0.8


def test_a_round_wall_neither_turns_nor_bends(shapes):
    item = standing(shapes, "bowl", shapes.bowl())
    sections = CrossSectionCache(item.vertices, item.faces)
    for azimuth in np.linspace(0.0, 6.0, 7):
        wall = wall_at(sections, 0.05, azimuth, CONFIG)
        turn, bend = _turn_and_bend(sections, 0.05, azimuth, wall, CONFIG)
        assert abs(turn) < np.deg2rad(1.5) and bend < np.deg2rad(3)
