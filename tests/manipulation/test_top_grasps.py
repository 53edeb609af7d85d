from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from manipulation.cross_sections import CrossSectionCache
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.standing import to_standing
from manipulation.top_grasps import top_grasps

CONFIG = GraspConfig()
HAND, CLEARANCE = 0.037, 0.004  # [m] from the TCP to the hand, and between the hand and what it passes


def standing(shapes, category, mesh, **where):
    return to_standing(shapes.estimate(1, category, mesh, **where))


def candidates(item, config=CONFIG):
    """Top grasps of an object, and the rejected candidates by reason."""
    rejected = Counter()
    return top_grasps(item, CrossSectionCache(item.vertices, item.faces), config, rejected), rejected


def test_can_is_held_around_its_axis_from_above(shapes):
    item = standing(shapes, "can", shapes.can(radius=0.033, height=0.12))
    for grasp in grasp_candidates(item, CONFIG).grasps:
        assert grasp.kind == "top" and grasp.depth in CONFIG.top_depths
        assert grasp.T_stand_tcp[:2, 3] == pytest.approx([0, 0], abs=3e-4)
        assert grasp.T_stand_tcp[2, 3] == pytest.approx(0.12 - grasp.depth)
        assert grasp.held_width == pytest.approx(0.066, abs=2e-4)
        low, high = grasp.closed_width  # a body a fifth wider than it looked is held all the same
        assert low < 0.066 and 0.074 < high < grasp.opening


def test_a_body_is_held_by_its_uppermost_part_only_if_nothing_else_is_possible(shapes):
    """The hand, which is 37 mm above the TCP, clears a wall of 80 mm beside a can of 54 mm."""
    grasps = grasp_candidates(standing(shapes, "can", shapes.can(height=0.054)), CONFIG).grasps
    clear = {grasp.depth for grasp in grasps if grasp.T_stand_tcp[2, 3] > 0.08 + CLEARANCE - HAND}
    assert clear == {min(CONFIG.top_depths)}
    assert all(grasp.depth not in clear for grasp in grasps[: len(grasps) // 2])


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


def test_every_top_grasp_is_generated_with_both_finger_orders(shapes):
    grasps, rejected = candidates(standing(shapes, "can", shapes.can()))
    assert not rejected and len(grasps) == len(CONFIG.top_depths) * CONFIG.n_azimuths
    for grasp in grasps:
        swapped = grasp.T_stand_tcp @ np.diag([-1.0, -1, 1, 1])
        assert any(np.allclose(swapped, other.T_stand_tcp, atol=1e-9) for other in grasps)


def test_bodies_wider_than_the_opening_are_rejected(shapes):
    """The opening is 80 mm; 3 mm more are accepted, because estimated bodies may be too wide."""
    fits, _ = candidates(standing(shapes, "can", shapes.can(radius=0.0412)))
    assert fits and max(grasp.opening for grasp in fits) == CONFIG.gripper.max_width
    none, rejected = candidates(standing(shapes, "can", shapes.can(radius=0.0418)))
    assert not none and rejected == {"too wide for 0.08 m": 12 * len(CONFIG.top_depths)}


def test_tapered_bodies_are_rejected_beyond_the_limit_of_friction(shapes):
    for taper, held in ((np.deg2rad(25), True), (np.deg2rad(29), False)):
        slant = 0.1 * np.tan(taper)
        outline = np.array([(0, 0), (0.02 + slant, 0), (0.02, 0.1), (0, 0.1)])
        frustum = trimesh.creation.revolve(outline, sections=48)
        item = standing(shapes, "bottle", frustum)
        grasps, rejected = candidates(item, GraspConfig(top_depths=(0.02,)))
        assert bool(grasps) == held, rejected
    assert rejected == {"too tapered": 12}


def test_pads_stay_away_from_a_shoulder_that_may_begin_lower(shapes):
    """The body is straight up to 13 mm below its top, where the pads of the usual depth end."""
    outline = np.array([(0, 0), (0.032, 0), (0.032, 0.147), (0.012, 0.16), (0, 0.16)])
    item = standing(shapes, "bottle", trimesh.creation.revolve(outline, sections=48))

    def best_depth(height_error):
        grasps, _ = candidates(item, replace(CONFIG, height_error=height_error))
        return max(grasps, key=lambda grasp: grasp.score).depth

    assert best_depth(0.0) == CONFIG.top_depths[0]
    assert best_depth(0.004) > CONFIG.top_depths[0]


def test_low_bodies_are_rejected_where_the_fingertips_would_touch_the_support(shapes):
    """Depth 12 mm, fingertips 9.5 mm further, 5 mm of clearance: 26.5 mm are needed."""
    config = GraspConfig(top_depths=(0.012,))
    assert candidates(standing(shapes, "can", shapes.can(height=0.027)), config)[0]
    none, rejected = candidates(standing(shapes, "can", shapes.can(height=0.026)), config)
    assert not none and rejected == {"too low": 12}


def test_the_hand_is_centred_on_an_eccentric_neck(shapes):
    neck = trimesh.creation.cylinder(0.012, 0.06, sections=48).apply_translation((0.01, -0.015, 0.13))
    body = trimesh.creation.cylinder(0.035, 0.1, sections=48).apply_translation((0, 0, 0.05))
    item = standing(shapes, "bottle", trimesh.boolean.union([body, neck]))
    grasps, _ = candidates(item, GraspConfig(top_depths=(0.022,)))
    assert grasps
    for grasp in grasps:
        assert grasp.T_stand_tcp[:2, 3] == pytest.approx([0.01, -0.015], abs=3e-4)
        assert grasp.held_width == pytest.approx(0.024, abs=3e-4)
        assert grasp.opening == pytest.approx(2 * (0.012 + 0.012), abs=5e-4)
        assert grasp.release_opening == pytest.approx(2 * (0.012 + CONFIG.release_gap), abs=5e-4)
