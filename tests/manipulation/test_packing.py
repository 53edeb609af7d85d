from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from manipulation.errors import PlanningError
from manipulation.footprints import BoxRaster, footprint
from manipulation.grasps import grasp_candidates
from manipulation.nesting import nest_heights, nests, radial_profile, radial_surfaces, stack_bowls
from manipulation.packing import admissible_yaws, nest_drop, pack
from manipulation.packing_problem import PackingConfig
from manipulation.pick_place import PickPlaceConfig
from manipulation.release_clearance import ReleasePose, count_free_releases
from manipulation.robot import GripperGeometry
from manipulation.standing import to_standing
from manipulation.types import Box

CONFIG = PackingConfig(gaps=(0.010, 0.005), n_handle_directions=2)  # fewer than the defaults, for speed


def items_of(shapes, *kinds):
    """Standing objects from (category, mesh) pairs."""
    return [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]


def outlines(item, placement):
    """Corners of the object's outlines where it is to stand."""
    shape = footprint(item).rotated(placement.yaws[0])
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
    assert later == sorted(later), "low objects are released before tall ones are beside them"


def test_bowls_that_something_rests_on_come_last_where_the_hand_reaches_them(kitchen):
    placements, left_out = pack(kitchen, Box(), CONFIG, resting={"can_3": "bowl_5"})
    assert not left_out
    assert [goal.name for goal in placements[-2:]] == ["bowl_5", "bowl_1"]
    assert placements[-1].stack == ("bowl_5",)


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
    with pytest.raises(PlanningError, match="no object to pack"):
        pack([], Box())


def test_bowls_that_do_not_fit_into_each_other_stand_apart(shapes):
    bowls = items_of(shapes, *[("bowl", shapes.bowl(0.06, slope=0.0))] * 2)
    assert nests(*map(radial_surfaces, bowls)) is None
    assert [len(stack) for stack in stack_bowls(bowls)] == [1, 1]
    placements, left_out = pack(bowls, Box(), CONFIG)
    assert not left_out and all(not placement.stack for placement in placements)
    assert_layout(bowls, placements, Box())


def test_what_is_lower_than_the_walls_stands_away_from_them(shapes):
    (can,) = items_of(shapes, ("can", shapes.can(radius=0.03, height=0.06)))
    box = Box()
    (placement,), left_out = pack([can], box)
    assert not left_out
    raster = BoxRaster(box, 0.0)
    position = np.array(placement.position[:2]) - box.center
    corner = np.array(box.size[:2]) / 2 - 0.04
    grasps = grasp_candidates(can).grasps
    assert count_free_releases(raster, grasps, ReleasePose(corner, 0.0, placement.position[2] + 0.003)) == 0
    assert count_free_releases(raster, grasps, ReleasePose(position, 0.0, placement.position[2] + 0.003)) > 0


def test_admissible_yaws_of_each_kind(shapes):
    mug, can, flat = items_of(
        shapes, ("mug", shapes.mug()), ("can", shapes.can()), ("bottle", shapes.flat_bottle())
    )
    assert admissible_yaws(mug, 0.3) == (0.3,)
    assert admissible_yaws(flat, 0.3) == pytest.approx((0.3, 0.3 + np.pi))
    assert np.diff(admissible_yaws(can, 0.3)) == pytest.approx(np.full(15, np.pi / 8))


def test_nested_bowls_are_released_with_the_finger_above_all_rims(shapes):
    large, small = items_of(
        shapes, ("bowl", shapes.bowl(0.075, 0.06, slope=0.3)), ("bowl", shapes.bowl(0.062, 0.045, slope=0.3))
    )
    hand = GripperGeometry()
    lift = nest_heights([large, small])[1]
    for depth in (0.010, 0.015):
        fingertip = lift + small.top - depth - hand.tip
        expected = large.top - fingertip + 0.006
        assert nest_drop([large, small], depth, CONFIG, hand) == pytest.approx(expected)
    assert nest_drop([large, small], 0.1, CONFIG, hand) == CONFIG.max_drop
    assert nest_drop([small, large], -0.1, CONFIG, hand) == CONFIG.release_height


def test_nests_leave_room_for_the_widest_release():
    config = PickPlaceConfig()
    widest = config.grasp.release_gap + max(config.segments.release_extras)
    assert CONFIG.nest_opening == pytest.approx(widest)


def test_a_much_smaller_bowl_is_released_between_the_walls_of_the_one_below(shapes):
    hand = GripperGeometry()
    margins = CONFIG.nest_opening + CONFIG.nest_clearance
    # The second radius leaves room for the fingertip, but not for the thicker finger above it.
    for radius, drops in ((0.063, True), (0.054, True), (0.046, False)):
        large, small = items_of(
            shapes,
            ("bowl", shapes.bowl(0.085, 0.06, slope=0.0)),
            ("bowl", shapes.bowl(radius, 0.045, slope=0.0)),
        )
        cavity = radial_profile(large).inner.max() - radial_profile(small).outer.max()
        assert (cavity < margins + hand.finger_thickness) == drops, "the case is what it is to be"
        assert (cavity < margins + hand.pad_thickness) == (radius == 0.063), "the case is what it is to be"
        drop = nest_drop([large, small], 0.015, CONFIG, hand)
        assert drop > 0.03 if drops else drop == CONFIG.release_height


@pytest.mark.parametrize(("gap", "from_wall"), [(0.024, 0.014), (0.010, 0.010), (0.005, 0.008)])
def test_walls_are_as_far_as_neighbours_up_to_a_limit(shapes, gap, from_wall):
    (can,) = items_of(shapes, ("can", shapes.can(height=0.12)))
    (placement,), _ = pack([can], Box(), PackingConfig(gaps=(gap,)))
    low, high = (np.array(Box().center) + side * np.array(Box().size[:2]) / 2 for side in (-1, 1))
    (outline,) = outlines(can, placement)
    apart_from_walls = min((outline - low).min(), (high - outline).min())
    assert from_wall - 1e-3 <= apart_from_walls <= from_wall + 0.006  # rounded to cells


def test_objects_keep_the_gap_from_each_other_and_the_wall_gap(shapes):
    box = Box(size=(0.16, 0.1, 0.08))
    cans = items_of(shapes, *[("can", shapes.can(0.033, 0.12))] * 2)
    placements, left_out = pack(cans, box, PackingConfig(gaps=(0.016, 0.004), wall_gaps=(0.004,)))
    assert not left_out
    first, second = (np.array(p.position[:2]) - box.center for p in placements)
    assert np.linalg.norm(first - second) >= 0.066 + 0.004 - 1e-9
    for position in (first, second):
        assert (np.abs(position) <= np.array([0.08, 0.05]) - 0.004 - 0.033 + 0.005).all()
