"""Success on hand-made states: every reason once, and none where all is well."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from app.task.criteria import BoxSpace, TrueObject, judge_pack, judge_sort, judge_standing

BOX = BoxSpace(center=(0.5, 0.27), size=(0.34, 0.30), floor=0.004)
LINE = ((0.66, 0.16), (-0.10, 0.56))


def thing(category="can", x=0.5, y=0.27, z=0.004, radius=0.03, height=0.1, yaw_deg=0.0, tilt_deg=0.0):
    """A cylinder; a bowl is a cone with an opening angle of 45 degrees, a floor and a wall of 4 mm."""
    profile = np.array([(0, 0), (radius, 0), (radius, height), (0, height)])
    if category == "bowl":
        height = radius - 0.02
        profile = np.array([(0, 0), (0.02, 0), (radius, height), (radius - 0.004, height), (0.02, 0.004)])
        profile = np.concatenate([profile, [(0, 0.004)]])
    mesh = trimesh.creation.revolve(profile, sections=24)
    yaw, tilt = np.deg2rad(yaw_deg), np.deg2rad(tilt_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn @ lean, (x, y, z)
    return TrueObject(category, np.asarray(mesh.vertices), np.asarray(mesh.faces), height, radius, T)


def test_standing():
    objects = [thing(), thing(tilt_deg=9.9), thing(tilt_deg=12), thing(tilt_deg=90), thing(z=-0.7)]
    assert judge_standing(objects) == ["", "", "tilted by 12 deg", "toppled by 90 deg", "fell off the table"]
    limits = [thing(tilt_deg=10.1), thing(tilt_deg=44), thing(tilt_deg=46), thing(z=-0.049), thing(z=-0.051)]
    assert judge_standing(limits) == [
        "tilted by 10 deg", "tilted by 44 deg", "toppled by 46 deg", "", "fell off the table",
    ]  # fmt: skip


def test_yaw_is_the_direction_of_the_handle_and_tilt_that_of_the_axis():
    item = thing("mug", yaw_deg=30, tilt_deg=5)
    assert item.yaw == pytest.approx(np.deg2rad(30)) and item.tilt == pytest.approx(np.deg2rad(5))
    np.testing.assert_allclose(thing(z=0.1).vertices_world[:, 2].min(), 0.1)


def test_an_object_upside_down_has_toppled():
    assert judge_standing([thing(tilt_deg=180)]) == ["toppled by 180 deg"]


def tapered(narrower, tilt_deg=180.0):
    """A can on the plane z = 0.1 m whose top is narrower than its bottom [m]."""
    profile = np.array([(0, 0), (0.03, 0), (0.03 - narrower, 0.1), (0, 0.1)])
    mesh = trimesh.creation.revolve(profile, sections=48)
    item = thing(tilt_deg=tilt_deg, z=0.2)
    return replace(item, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))


def test_either_of_two_like_ends_may_be_below():
    turned = tapered(0.0).on_like_end()
    assert turned.tilt == pytest.approx(0.0, abs=1e-6)
    # The base is now the lower end, which had been the top.
    np.testing.assert_allclose(turned.base, tapered(0.0).T_world_object[:3] @ (0, 0, 0.1, 1), atol=1e-9)
    np.testing.assert_allclose(
        np.sort(turned.vertices_world, axis=0), np.sort(tapered(0.0).vertices_world, axis=0), atol=1e-9
    )
    assert judge_standing([turned]) == [""]


@pytest.mark.parametrize("item", [tapered(0.006), thing("bowl", tilt_deg=180), tapered(0.0, 90.0)])
def test_unlike_ends_and_lying_objects_count_as_they_are(item):
    assert item.on_like_end() is item


def test_a_well_packed_box():
    objects = [
        thing("bowl", x=0.42, radius=0.07, z=0.004),
        thing("bowl", x=0.425, radius=0.06, z=0.015),
        thing("mug", x=0.58, y=0.20, yaw_deg=88),
        thing("mug", x=0.58, y=0.28, yaw_deg=95),
        thing("mug", x=0.585, y=0.36, yaw_deg=91),
        thing("bottle", x=0.5, height=0.25),
    ]
    assert judge_pack(objects, BOX) == [""] * 6


@pytest.mark.parametrize(
    ("item", "reason"),
    [
        (thing(x=0.64), ""),
        (thing(x=0.6415), ""),  # 1.5 mm into the wall
        (thing(x=0.6425), "outside the box by 2 mm"),
        (thing(x=0.67), "outside the box by 30 mm"),
        (thing(x=0.33), "outside the box by 30 mm"),
        (thing(y=0.3915), ""),
        (thing(y=0.3925), "outside the box by 2 mm"),
        (thing(y=0.1477), "outside the box by 2 mm"),
        (thing(y=0.0), "outside the box by 150 mm"),
        (thing(z=0.0185), ""),
        (thing(z=0.0195), "not on the floor of the box but 16 mm above"),
        (thing(z=0.05), "not on the floor of the box but 46 mm above"),
        (thing(tilt_deg=11), "tilted by 11 deg"),
    ],
)
def test_badly_packed(item, reason):
    assert judge_pack([item], BOX) == [reason]


def test_the_whole_outline_must_be_inside_not_the_base_alone():
    """A can leaning by 9 degrees against the wall: its top edge is 15 mm beyond that of its base."""
    assert judge_pack([thing(y=0.385, tilt_deg=-9)], BOX) == ["outside the box by 10 mm"]
    assert judge_pack([thing(y=0.375, tilt_deg=-9)], BOX) == [""]


def test_bowls_must_be_nested_with_the_largest_lowest():
    large, small = thing("bowl", radius=0.07, z=0.004), thing("bowl", radius=0.06, z=0.02)
    assert judge_pack([large, small], BOX) == ["", ""]
    upside = [thing("bowl", radius=0.07, z=0.02), thing("bowl", radius=0.06, z=0.004)]
    assert sorted(judge_pack(upside, BOX)) == ["", "bowl nested in the wrong order"]
    alike = [thing("bowl", radius=0.062, z=0.02), thing("bowl", radius=0.060, z=0.004)]
    assert judge_pack(alike, BOX) == ["", ""]  # 2 mm apart: either way
    beside = [thing("bowl", x=0.41, radius=0.07), thing("bowl", x=0.58, radius=0.06)]
    assert sorted(judge_pack(beside, BOX)) == ["", "bowl beside the nest"]
    hung = [thing("bowl", radius=0.05, z=0.1)]
    assert judge_pack(hung, BOX) == ["bowl on something that is no bowl"]


def test_nested_bowls_share_an_axis():
    lower = thing("bowl", x=0.45, radius=0.07)
    for offset, reasons in ((0.029, ["", ""]), (0.031, ["", "bowl beside the nest"])):
        assert judge_pack([lower, thing("bowl", x=0.45 + offset, radius=0.06, z=0.02)], BOX) == reasons


def test_nest_order_has_a_tolerance_of_three_millimetres():
    def verdict(lower, upper):
        return judge_pack([thing("bowl", radius=lower), thing("bowl", radius=upper, z=0.02)], BOX)

    assert verdict(0.060, 0.0629) == ["", ""]
    assert verdict(0.060, 0.0631).count("bowl nested in the wrong order") == 1


def test_the_lowest_bowl_of_a_nest_stands_on_the_floor():
    for z, reason in ((0.0185, ""), (0.0195, "bowl on something that is no bowl")):
        assert judge_pack([thing("bowl", radius=0.05, z=z)], BOX) == [reason]


def solid_bowl(**place):
    """A bowl without a cavity: no other one can sit in it."""
    cylinder = thing("can", **place)
    return replace(cylinder, category="bowl")


def test_bowls_whose_shapes_exclude_nesting_may_stand_side_by_side():
    apart = [solid_bowl(x=0.41, radius=0.06), solid_bowl(x=0.58, radius=0.06)]
    assert judge_pack(apart, BOX) == ["", ""]
    three = [*apart, thing("bowl", x=0.5, y=0.36, radius=0.05)]
    assert judge_pack(three, BOX) == ["", "", ""]
    spare = [thing("bowl", x=0.41, y=0.2, radius=0.07), thing("bowl", x=0.58, y=0.2, radius=0.06)]
    spare.append(solid_bowl(y=0.35, radius=0.065))
    assert judge_pack(spare, BOX).count("bowl beside the nest") == 1  # two nests suffice for the three


def test_a_nested_bowl_must_sit_inside_the_one_beneath():
    lower = thing("bowl", radius=0.07)  # 50 mm high

    def verdict(lift):
        return judge_pack([lower, thing("bowl", radius=0.06, z=lower.base[2] + lift)], BOX)

    assert verdict(0.039) == ["", ""]
    assert verdict(0.041) == ["", "bowl not seated in the nest but 41 mm above the bowl beneath"]
    middle = thing("bowl", radius=0.06, z=lower.base[2] + 0.03)  # 40 mm high
    upper = thing("bowl", radius=0.05, z=lower.base[2] + 0.06)
    assert judge_pack([lower, middle, upper], BOX) == ["", "", ""]  # each lift from the bowl beneath


def test_mugs_must_point_one_way_and_stand_in_a_row():
    def mugs(*yaws, x=(0.4, 0.5, 0.6)):
        return [thing("mug", x=x[i], yaw_deg=yaw) for i, yaw in enumerate(yaws)]

    assert judge_pack(mugs(175, -175), BOX) == ["", ""]
    assert judge_pack(mugs(0, 14, 7), BOX) == ["", "", ""]
    assert judge_pack(mugs(0, 40, 5), BOX) == ["", "handle 40 deg from the others'", ""]
    assert judge_pack(mugs(0, 16), BOX) == ["", "handle 16 deg from the others'"]
    assert judge_pack(mugs(0, 14.9), BOX) == ["", ""] and "" in judge_pack(mugs(0, 15.1), BOX)
    assert judge_pack(mugs(0, 15.1), BOX)[1] == "handle 15 deg from the others'"
    # The middle mug of three is off a straight row by d: two thirds of d from the best line.
    for offset, wrong in ((0.0295, 0), (0.0305, 1), (0.07, 1)):
        crooked = [thing("mug", x=0.4), thing("mug", x=0.5, y=0.27 + offset), thing("mug", x=0.6)]
        assert judge_pack(crooked, BOX).count("mug out of the row of mugs") == wrong


def on_line(distance, **changes):
    start, end = map(np.array, LINE)
    along = (end - start) / np.linalg.norm(end - start)
    x, y = start + distance * along
    return thing(x=x, y=y, z=0.0, **changes)


def test_a_sorted_line():
    objects = [on_line(0.1 + 0.15 * i, height=0.08 + 0.03 * i) for i in range(4)]
    assert judge_sort(objects, [LINE]) == [""] * 4


def test_order_counts_from_three_millimetres_on():
    alike = [on_line(0.1, height=0.102), on_line(0.3, height=0.100)]
    assert judge_sort(alike, [LINE]) == ["", ""]
    for difference, wrong in ((0.0029, 0), (0.0031, 1)):
        first, second = on_line(0.1), on_line(0.3)
        height = np.sqrt((second.size + difference) ** 2 - (2 * second.radius) ** 2)
        first = replace(first, height=float(height))
        assert first.size - second.size == pytest.approx(difference)
        assert judge_sort([first, second], [LINE]).count("out of order by size") == wrong
    swapped = [on_line(0.1, height=0.12), on_line(0.3, height=0.10), on_line(0.5, height=0.15)]
    assert judge_sort(swapped, [LINE]).count("out of order by size") == 1
    reversed_line = [on_line(0.5, height=0.10), on_line(0.3, height=0.12), on_line(0.1, height=0.15)]
    assert judge_sort(reversed_line, [LINE]).count("out of order by size") == 2


def test_order_is_that_on_the_line_whatever_the_order_of_the_list():
    objects = [on_line(0.1 + 0.15 * i, height=0.08 + 0.03 * i) for i in (2, 0, 3, 1)]
    assert judge_sort(objects, [LINE]) == [""] * 4


def test_a_toppled_object_is_not_sorted():
    assert judge_sort([on_line(0.1, tilt_deg=90)], [LINE]) == ["toppled by 90 deg"]


def test_off_the_line():
    aside = on_line(0.3)
    T = np.array(aside.T_world_object)
    T[:2, 3] += 0.035 * np.array([0.466, 0.885])  # the line's normal
    aside = replace(aside, T_world_object=T)
    assert judge_sort([on_line(0.1), aside], [LINE]) == ["", "off the line by 3.5 cm"]
    length = float(np.hypot(LINE[1][0] - LINE[0][0], LINE[1][1] - LINE[0][1]))
    for distance, reason in (
        (-0.019, ""),
        (-0.021, "off the line by 2.1 cm"),
        (-0.1, "off the line by 10.0 cm"),
        (length + 0.019, ""),
        (length + 0.021, "off the line by 2.1 cm"),
    ):
        assert judge_sort([on_line(distance)], [LINE]) == [reason]


@pytest.mark.parametrize(("aside", "reason"), [(0.019, ""), (0.021, "off the line by 2.1 cm")])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_line_is_two_centimetres_wide_on_either_side(aside, reason, side):
    along = np.array(LINE[1]) - np.array(LINE[0])
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    x, y = on_line(0.3).base[:2] + side * aside * normal
    assert judge_sort([thing(x=x, y=y, z=0.0)], [LINE]) == [reason]


def test_sizes_ascend_from_row_to_row():
    """The first half of the line and, as a second row, the second half: order counts across them."""
    middle = ((LINE[0][0] + LINE[1][0]) / 2, (LINE[0][1] + LINE[1][1]) / 2)
    halves = [(LINE[0], middle), (middle, LINE[1])]
    ascending = [on_line(0.1, height=0.08), on_line(0.3, height=0.1), on_line(0.6, height=0.12)]
    assert judge_sort(ascending, halves) == ["", "", ""]
    swapped_rows = judge_sort(ascending, halves[::-1])
    assert swapped_rows.count("out of order by size") == 1 and swapped_rows[:2] == ["", ""]
    aside = thing(x=0.3, y=0.0, z=0.0)
    assert judge_sort([aside], halves)[0].startswith("off the line by ")
