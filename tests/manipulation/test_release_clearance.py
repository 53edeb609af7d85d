from dataclasses import replace

import numpy as np
import pytest

from manipulation.footprints import BoxRaster, Stencil, footprint
from manipulation.grasp_config import tcp_pose
from manipulation.grasps import grasp_candidates
from manipulation.release_clearance import (
    FINGER_CLEARANCE,
    PALM_CLEARANCE,
    ReleasePose,
    count_free_releases,
)
from manipulation.robot import GripperGeometry
from manipulation.standing import to_standing
from manipulation.types import Box, Grasp


def items_of(shapes, *kinds):
    """Standing objects from (category, mesh) pairs."""
    return [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]


def test_a_tall_neighbour_takes_the_hands_room(shapes):
    mug, tall = items_of(shapes, ("mug", shapes.mug()), ("bottle", shapes.bottle(radius=0.04, height=0.26)))
    grasps = grasp_candidates(mug).grasps
    raster = BoxRaster(Box(), 0.008)
    free = count_free_releases(raster, grasps, ReleasePose(np.zeros(2), 0.0, 0.004))
    assert free == len(grasps)
    stencil = Stencil.of(footprint(tall), 0.0, raster.cell)
    raster.add(stencil, (len(raster.x) // 2, len(raster.y) // 2 + 18))
    assert 0 < count_free_releases(raster, grasps, ReleasePose(np.zeros(2), 0.0, 0.004)) < free
    assert count_free_releases(raster, [], ReleasePose(np.zeros(2), 0.0, 0.0)) == 0
    broad = GripperGeometry(palm_half_width=0.08)
    assert count_free_releases(raster, grasps, ReleasePose(np.zeros(2), 0.0, 0.004), broad) == 0


def test_a_tilted_hand_reaches_lower_on_one_side(shapes):
    """Over the rim of a low bowl whose wall leans by 30 degrees, the palm comes down to the wall outside."""
    (bowl,) = items_of(shapes, ("bowl", shapes.bowl(radius=0.065, height=0.04, slope=np.deg2rad(30))))
    grasps = grasp_candidates(bowl).grasps
    box = replace(Box(), size=(0.5, 0.5, 0.08))
    raster = BoxRaster(box, 0.008)
    assert count_free_releases(raster, grasps, ReleasePose(np.zeros(2), 0.0, 0.004)) == len(grasps)
    in_the_corner = np.array(box.size[:2]) / 2 - 0.065 - 0.01
    assert 0 < count_free_releases(raster, grasps, ReleasePose(in_the_corner, 0.0, 0.004)) < 0.6 * len(grasps)
    outwards = [grasp for grasp in grasps if np.cos(grasp.azimuth - np.pi / 4) > 0.8]
    assert count_free_releases(raster, outwards, ReleasePose(in_the_corner, 0.0, 0.004)) == 0


def grasp_at(height, opening):
    """A vertical grasp on the axis with the closing direction along y and the TCP at a height."""
    T = tcp_pose(np.array([0.0, 0.0, height]), np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0]))
    return Grasp("top", T, np.array([0.0, 0.0, 1.0]), 0.08, 0.03, (0.01, 0.07), opening, 0.02, 0.0, 1.0)


def raster_with_post(x, y, height):
    """A large empty box with a post of 10 mm at a point."""
    raster = BoxRaster(Box(size=(0.6, 0.6, 0.08)), 0.0)
    i, j = (int(np.argmin(np.abs(axis - value))) for axis, value in ((raster.x, x), (raster.y, y)))
    raster.heights[i - 1 : i + 2, j - 1 : j + 2] = height
    return raster


HAND = GripperGeometry()
ORIGIN = ReleasePose(np.zeros(2), 0.0, 0.0)


@pytest.mark.parametrize("side", [-1, 1])
def test_each_finger_is_above_the_scene(side):
    """At an opening of 40 mm the fingers are 20 to 40.5 mm from the axis, their tips 9.5 mm below the TCP."""
    grasp = grasp_at(0.1, 0.04)
    clear = 0.1 - HAND.tip - FINGER_CLEARANCE
    for offset in (0.022, 0.038):
        assert count_free_releases(raster_with_post(0.0, side * offset, clear - 0.001), [grasp], ORIGIN) == 1
        assert count_free_releases(raster_with_post(0.0, side * offset, clear + 0.001), [grasp], ORIGIN) == 0
    assert count_free_releases(raster_with_post(0.0, side * 0.055, clear + 0.001), [grasp], ORIGIN) == 1
    assert count_free_releases(raster_with_post(0.0, 0.0, clear + 0.001), [grasp], ORIGIN) == 1, (
        "between them"
    )
    closed = grasp_at(0.1, 0.008)
    assert count_free_releases(raster_with_post(0.0, side * 0.01, clear + 0.001), [closed], ORIGIN) == 0


@pytest.mark.parametrize("offset", [(0.015, 0.1), (-0.015, -0.1), (0.033, 0.05), (-0.033, 0.0)])
def test_the_palm_is_above_the_scene(offset):
    """The palm, 210 mm by 70 mm, is 37 mm above the TCP."""
    grasp, clear = grasp_at(0.1, 0.04), 0.1 + HAND.palm - PALM_CLEARANCE
    assert count_free_releases(raster_with_post(*offset, clear - 0.001), [grasp], ORIGIN) == 1
    assert count_free_releases(raster_with_post(*offset, clear + 0.001), [grasp], ORIGIN) == 0


def test_the_hand_moves_with_the_release_pose():
    grasp, clear = grasp_at(0.1, 0.04), 0.1 - HAND.tip - FINGER_CLEARANCE
    raster = raster_with_post(0.1 - 0.03, 0.05, clear + 0.02)
    at_post = ReleasePose(np.array([0.1, 0.05]), np.pi / 2, 0.0)  # fingers along x
    assert count_free_releases(raster, [grasp], at_post) == 0
    assert count_free_releases(raster, [grasp], ReleasePose(at_post.position, 0.0, 0.0)) == 1
    assert count_free_releases(raster, [grasp], ReleasePose(at_post.position, np.pi / 2, 0.025)) == 1


def test_the_fingers_of_one_jaw_are_on_the_side_of_its_opening(shapes):
    """Something beside the fixed pad, nearer than half an opening: free for one jaw, not for two fingers."""
    (can,) = items_of(shapes, ("can", shapes.can(radius=0.02, height=0.1)))
    approach, closing = np.array([0, 0, -1.0]), np.array([0, 1.0, 0])
    grasp = Grasp(
        kind="top", T_stand_tcp=tcp_pose(np.array([0, 0, 0.09]), approach, closing),
        away=np.array([0, 0, 1.0]), opening=0.06, held_width=0.04, closed_width=(0.02, 0.05),
        release_opening=0.06, depth=0.01, azimuth=0.0, score=1.0,
    )  # fmt: skip
    thin = GripperGeometry(finger_reach=0.004, finger_half_width=0.002, palm=0.2)
    counts = []
    for gripper in (thin, replace(thin, one_jaw=True)):
        raster = BoxRaster(replace(Box(), size=(0.5, 0.5, 0.08)), 0.004)
        middle = len(raster.x) // 2, len(raster.y) // 2 - 8  # 32 mm on the side of -y
        raster.add(Stencil.of(footprint(can), 0.0, raster.cell), middle)
        counts.append(count_free_releases(raster, [grasp], ReleasePose(np.zeros(2), 0.0, -0.05), gripper))
    assert counts == [0, 1]
