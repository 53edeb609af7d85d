"""Uncertain parts of a shape are widened, and grasps at them come later."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from manipulation.footprints import footprint
from manipulation.grasps import grasp_candidates
from manipulation.hulls import convex_pieces
from manipulation.robot import GripperGeometry
from manipulation.standing import to_standing
from manipulation.uncertainty import outer_vertices, ranked, success_probability

HAND = GripperGeometry()


@pytest.fixture
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(radius=0.03, height=0.1)))


def uncertain(item, sigma, where=lambda vertices: np.ones(len(vertices), bool)):
    return replace(item, sigma=np.where(where(item.vertices), sigma, 0.0005))


def test_what_the_ordinary_clearances_cover_is_not_widened(can):
    assert outer_vertices(can) is can.vertices
    covered = uncertain(can, 0.004)
    assert outer_vertices(covered) is covered.vertices


@pytest.mark.parametrize("sigma, excess", [(0.007, 0.006), (0.05, 0.010)])
def test_uncertain_sides_move_outwards_by_two_deviations_less_the_clearance(can, sigma, excess):
    hidden = uncertain(can, sigma, lambda v: v[:, 0] > 0.02)
    moved = outer_vertices(hidden)
    middle = (can.vertices[:, 2] > 0.03) & (can.vertices[:, 2] < 0.07)
    sides = np.hypot(*can.vertices[:, :2].T) > 0.029
    far, near = can.vertices[:, 0] > 0.02, can.vertices[:, 0] < 0.019
    reach = np.hypot(*moved[:, :2].T) - np.hypot(*can.vertices[:, :2].T)
    assert reach[far & sides].min() > 0.5 * excess  # at the edges the normal points up or down, too
    if (far & sides & middle).any():
        np.testing.assert_allclose(reach[far & sides & middle], excess, rtol=0.02)
    np.testing.assert_array_equal(moved[near], can.vertices[near])
    assert moved[:, 2].min() == can.vertices[:, 2].min()


def test_collision_bodies_and_footprints_are_wider(can):
    wide = uncertain(can, 0.007)
    for of in (lambda item: footprint(item).reach(np.array([1.0, 0.0])),
               lambda item: max(float(piece[:, 0].max()) for piece in convex_pieces(item))):  # fmt: skip
        assert of(wide) - of(can) > 0.003


def test_the_probability_is_that_both_pads_pass(can):
    grasp = grasp_candidates(can).grasps[0]
    gap = 0.5 * (grasp.opening - grasp.held_width)
    assert success_probability(can, grasp, HAND) == 1.0
    assert success_probability(uncertain(can, gap), grasp, HAND) == pytest.approx(ndtr(1.0) ** 2)
    closing = grasp.T_stand_tcp[:3, 1]
    one_side = uncertain(can, gap / 2, lambda v: v @ closing > 0)
    assert success_probability(one_side, grasp, HAND) == pytest.approx(ndtr(2.0), abs=1e-3)
    jaw = replace(grasp, stand_off=0.25 * gap)
    assert success_probability(uncertain(can, gap), jaw, HAND) == pytest.approx(ndtr(0.25) * ndtr(1.75))


def test_grasps_at_the_hidden_side_come_after_the_others(can):
    hidden = uncertain(can, 0.012, lambda v: np.abs(v[:, 0]) > 0.02)
    found = grasp_candidates(hidden).grasps
    along_x = [abs(grasp.T_stand_tcp[0, 1]) for grasp in found]
    assert len(found) == len(grasp_candidates(can).grasps)
    assert max(along_x[: len(found) // 4]) < 0.8 and min(along_x[-len(found) // 8 :]) > 0.6


def test_sure_grasps_keep_their_order(can):
    grasps = grasp_candidates(can).grasps
    assert ranked(uncertain(can, 0.001), grasps, HAND) is grasps
    assert ranked(uncertain(can, 0.0045), grasps, HAND) == grasps  # all of them above SURE
    assert ranked(uncertain(can, 0.01), (), HAND) == ()
