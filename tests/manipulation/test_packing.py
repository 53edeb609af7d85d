from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from manipulation.errors import PlanningError
from manipulation.footprints import BoxRaster, Stencil, footprint
from manipulation.grasps import find_grasps
from manipulation.nesting import nest_heights, nests, radial_profile, stack_bowls
from manipulation.packing import PackingConfig, pack
from manipulation.release_clearance import count_releases
from manipulation.robot import GripperGeometry
from manipulation.sorting import SortingConfig, sort_line
from manipulation.standing import stand
from manipulation.types import Box, Line

CONFIG = PackingConfig(gaps=(0.010, 0.005), n_handle_directions=2)  # fewer than the defaults, for speed


def items_of(shapes, *kinds):
    """Standing objects from (category, mesh) pairs."""
    return [stand(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]


def outlines(item, placement):
    """Corners of the object's outlines where it is to stand."""
    shape = footprint(item).turned(placement.yaws[0])
    return [outline + np.array(placement.position[:2]) for outline in shape.outlines]


def apart(first, second):
    """Whether some direction separates two convex outlines (separating axes, finely sampled)."""
    angles = np.linspace(0, 2 * np.pi, 720)
    normals = np.stack([np.cos(angles), np.sin(angles)])
    return bool(((first @ normals).max(axis=0) < (second @ normals).min(axis=0)).any())


def assert_layout(items, placements, box):
    by_name = {item.name: item for item in items}
    low, high = (np.array(box.center) + side * np.array(box.size[:2]) / 2 for side in (-1, 1))
    for placement in placements:
        for outline in outlines(by_name[placement.name], placement):
            assert (outline >= low).all() and (outline <= high).all(), placement.name
    floor = [placement for placement in placements if not placement.stack]
    for a, b in combinations(floor, 2):
        for first in outlines(by_name[a.name], a):
            for second in outlines(by_name[b.name], b):
                assert apart(first, second), (a.name, b.name)


@pytest.fixture(scope="module")
def kitchen(shapes):
    return items_of(
        shapes,
        ("mug", shapes.mug()),
        ("bowl", shapes.bowl(radius=0.06, height=0.045)),
        ("bottle", shapes.bottle()),
        ("can", shapes.can()),
        ("mug", shapes.mug(radius=0.043, height=0.1)),
        ("bowl", shapes.bowl(radius=0.075)),
    )


def test_six_objects_fit_without_overlap(kitchen):
    placements, left_out = pack(kitchen, Box(), CONFIG)
    assert not left_out and len(placements) == 6
    assert_layout(kitchen, placements, Box())


def test_bowls_nest_largest_lowest_and_come_first(kitchen):
    placements, _ = pack(kitchen, Box(), CONFIG)
    first, second = placements[:2]
    assert (first.name, first.stack) == ("bowl_5", ())
    assert (second.name, second.stack) == ("bowl_1", ("bowl_5",))
    assert first.position == second.position
    assert 0.003 <= second.release_height <= CONFIG.max_drop
    tops = {item.name: item.top for item in kitchen}
    later = [tops[placement.name] for placement in placements[2:]]
    assert later == sorted(later), "the hand lets go of low objects before tall ones stand beside it"


def test_mugs_stand_in_line_with_handles_alike(shapes):
    mugs = items_of(shapes, *[("mug", shapes.mug(radius=r)) for r in (0.038, 0.04, 0.042)])
    placements, left_out = pack(mugs, Box(), CONFIG)
    assert not left_out
    assert len({placement.yaws for placement in placements}) == 1
    centres = np.array([placement.position[:2] for placement in placements])
    centred = centres - centres.mean(axis=0)
    assert np.linalg.svd(centred)[1][1] < 0.004
    assert_layout(mugs, placements, Box())


@settings(max_examples=4, deadline=None)
@given(
    radii=st.lists(st.floats(0.026, 0.045), min_size=1, max_size=7),
    size=st.tuples(st.floats(0.16, 0.4), st.floats(0.16, 0.4)),
)
def test_whatever_is_packed_lies_inside_and_apart(shapes, radii, size):
    items = items_of(shapes, *[("can", shapes.can(radius=r)) for r in radii])
    box = Box(size=(*size, 0.08))
    placements, left_out = pack(items, box, CONFIG)
    assert len(placements) + len(left_out) == len(items)
    assert_layout(items, placements, box)


def test_small_box_names_what_does_not_fit(kitchen):
    placements, left_out = pack(kitchen, Box(size=(0.2, 0.2, 0.08)), CONFIG)
    assert placements and left_out and not set(left_out) & {p.name for p in placements}
    reason = next(iter(left_out.values()))
    assert f"box too small: {len(placements)} of 6 fit into 0.20 x 0.20 m" in reason
    assert_layout(kitchen, placements, Box(size=(0.2, 0.2, 0.08)))


def test_nothing_fits_and_nothing_to_pack_are_errors(kitchen):
    with pytest.raises(PlanningError, match=r"box too small: 0 of 6 fit into 0.05 x 0.05 m"):
        pack(kitchen, Box(size=(0.05, 0.05, 0.05)), CONFIG)
    with pytest.raises(PlanningError, match="nothing to pack"):
        pack([], Box())


def test_nesting_heights_follow_from_the_walls(shapes):
    large, small = items_of(
        shapes, ("bowl", shapes.bowl(0.075, slope=0.3)), ("bowl", shapes.bowl(0.055, 0.045, slope=0.3))
    )
    heights = nest_heights([large, small])
    assert heights[0] == 0 and heights[1] == pytest.approx(0.005, abs=0.003), "small bowl stands on the floor"
    same = items_of(shapes, *[("bowl", shapes.bowl(0.07, wall=0.004, slope=0.5))] * 2)
    # Alike bowls touch along their walls: the upper one is up by wall / sin(slope).
    assert nest_heights(same)[1] == pytest.approx(0.004 / np.sin(0.5), abs=0.003)


def test_a_ragged_rim_does_not_close_a_bowl(shapes):
    whole = shapes.bowl(0.075, slope=0.3)
    vertices = np.array(whole.vertices)
    top = vertices[:, 2] > vertices[:, 2].max() - 0.0005
    spike = top & (np.abs(np.arctan2(vertices[:, 1], vertices[:, 0])) < 0.5)
    vertices[spike, 2] += 0.003
    ragged, small = items_of(
        shapes,
        ("bowl", trimesh.Trimesh(vertices, whole.faces)),
        ("bowl", shapes.bowl(0.055, 0.045, slope=0.3)),
    )
    assert nests(radial_profile(small), radial_profile(ragged)) == pytest.approx(0.005, abs=0.003)


def test_bowls_that_do_not_fit_into_each_other_stand_apart(shapes):
    bowls = items_of(shapes, *[("bowl", shapes.bowl(0.06, slope=0.0))] * 2)
    assert nests(*(radial_profile(bowl) for bowl in bowls)) is None
    assert [len(stack) for stack in stack_bowls(bowls)] == [1, 1]
    placements, left_out = pack(bowls, Box(), CONFIG)
    assert not left_out and all(not placement.stack for placement in placements)
    assert_layout(bowls, placements, Box())


def test_raster_keeps_walls_and_gaps(shapes):
    (item,) = items_of(shapes, ("can", shapes.can(radius=0.03)))
    raster = BoxRaster(Box(size=(0.2, 0.1, 0.08)), wall_gap=0.005)
    stencil = Stencil.of(footprint(item), 0.01, raster.cell)
    i, j = np.nonzero(raster.free_positions(stencil))
    assert np.abs(raster.x[i]).max() == pytest.approx(0.1 - 0.005 - 0.04, abs=0.006)
    assert np.abs(raster.y[j]).max() <= 0.05 - 0.005 - 0.03
    middle = (len(raster.x) // 2, len(raster.y) // 2)
    raster.add(stencil, middle, base=0.004)
    assert raster.highest(np.zeros(2)) == pytest.approx(0.124, abs=1e-3)
    assert raster.highest(np.array([0.104, 0.0])) == pytest.approx(Box().top)
    assert raster.highest(np.array([5.0, 0.0])) == 0
    i, _ = np.nonzero(raster.free_positions(stencil))
    assert np.abs(raster.x[i]).min(initial=np.inf) >= 0.03 + 0.03


def test_a_tall_neighbour_takes_the_hands_room(shapes):
    mug, tall = items_of(shapes, ("mug", shapes.mug()), ("bottle", shapes.bottle(radius=0.04, height=0.26)))
    grasps = find_grasps(mug).grasps
    raster = BoxRaster(Box(), 0.008)
    free = count_releases(raster, grasps, np.zeros(2), 0.0, 0.004)
    assert free == len(grasps)
    stencil = Stencil.of(footprint(tall), 0.0, raster.cell)
    raster.add(stencil, (len(raster.x) // 2, len(raster.y) // 2 + 18))
    assert 0 < count_releases(raster, grasps, np.zeros(2), 0.0, 0.004) < free
    assert count_releases(raster, [], np.zeros(2), 0.0, 0.0) == 0
    broad = GripperGeometry(palm_half_width=0.08)
    assert count_releases(raster, grasps, np.zeros(2), 0.0, 0.004, broad) == 0


def test_what_is_lower_than_the_walls_stands_away_from_them(shapes):
    (can,) = items_of(shapes, ("can", shapes.can(radius=0.03, height=0.06)))
    box = Box()
    (placement,), left_out = pack([can], box)
    assert not left_out
    raster = BoxRaster(box, 0.0)
    position = np.array(placement.position[:2]) - box.center
    corner = np.array(box.size[:2]) / 2 - 0.04
    grasps = find_grasps(can).grasps
    assert count_releases(raster, grasps, corner, 0.0, placement.position[2] + 0.003) == 0
    assert count_releases(raster, grasps, position, 0.0, placement.position[2] + 0.003) > 0


def test_a_tilted_hand_reaches_lower_on_one_side(shapes):
    """Over the rim of a low bowl whose wall leans by 30 degrees, the palm comes down to the wall outside."""
    (bowl,) = items_of(shapes, ("bowl", shapes.bowl(radius=0.065, height=0.04, slope=np.deg2rad(30))))
    grasps = find_grasps(bowl).grasps
    box = replace(Box(), size=(0.5, 0.5, 0.08))
    raster = BoxRaster(box, 0.008)
    assert count_releases(raster, grasps, np.zeros(2), 0.0, 0.004) == len(grasps)
    in_the_corner = np.array(box.size[:2]) / 2 - 0.065 - 0.01
    assert 0 < count_releases(raster, grasps, in_the_corner, 0.0, 0.004) < 0.6 * len(grasps)
    outwards = [grasp for grasp in grasps if np.cos(grasp.azimuth - np.pi / 4) > 0.8]
    assert count_releases(raster, outwards, in_the_corner, 0.0, 0.004) == 0


def test_sorted_objects_ascend_on_the_line(kitchen):
    line = Line()
    placements, left_out = sort_line(kitchen, line)
    assert not left_out
    position = {p.name: (np.array(p.position[:2]) - line.start) @ line.direction for p in placements}
    normal = np.array([-line.direction[1], line.direction[0]])
    for placement in placements:
        assert (np.array(placement.position[:2]) - line.start) @ normal == pytest.approx(0, abs=1e-9)
    ascending = sorted(kitchen, key=lambda item: item.size)
    along = [position[item.name] for item in ascending]
    assert along == sorted(along) and along[0] > 0 and along[-1] < line.length
    by_name = {item.name: item for item in kitchen}
    for a, b in combinations(placements, 2):
        for first in outlines(by_name[a.name], a):
            assert all(apart(first, second) for second in outlines(by_name[b.name], b))


def test_handles_stick_out_sideways_of_the_line(kitchen):
    line = Line()
    placements, _ = sort_line(kitchen, line)
    for placement in (p for p in placements if p.name.startswith("mug")):
        handle = np.array([np.cos(placement.yaws[0]), np.sin(placement.yaws[0])])
        assert handle @ line.direction == pytest.approx(0, abs=1e-9)
        assert len(placement.yaws) == 2


def test_short_line_leaves_out_the_widest(kitchen):
    line = Line((0.6, 0.2), (0.6, 0.75))
    placements, left_out = sort_line(kitchen, line, SortingConfig(min_gap=0.03))
    assert set(left_out) == {"bowl_5"}
    assert left_out["bowl_5"].startswith("line too short: 5 of 6 fit on 0.55 m")
    with pytest.raises(PlanningError, match=r"none of 6 objects fits on 0.05 m"):
        sort_line(kitchen, Line((0.6, 0.2), (0.6, 0.25)))
    with pytest.raises(PlanningError, match="nothing to sort"):
        sort_line([], line)
    assert len(placements) == 5
