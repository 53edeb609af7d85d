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
    objects = [thing(), thing(tilt_deg=9), thing(tilt_deg=12), thing(tilt_deg=90), thing(z=-0.7)]
    assert judge_standing(objects) == ["", "", "tilted by 12 deg", "toppled by 90 deg", "fell off the table"]


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
        (thing(x=0.64), "outside the box by 0 mm"),
        (thing(x=0.67), "outside the box by 30 mm"),
        (thing(y=0.0), "outside the box by 150 mm"),
        (thing(z=0.05), "not on the floor of the box but 46 mm above"),
        (thing(tilt_deg=11), "tilted by 11 deg"),
    ],
)
def test_badly_packed(item, reason):
    expected = "" if reason.endswith("by 0 mm") else reason
    assert judge_pack([item], BOX) == [expected]


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
    crooked = mugs(0, 0, 0)
    crooked[1] = thing("mug", x=0.5, y=0.34)
    assert [bool(reason) for reason in judge_pack(crooked, BOX)].count(True) == 1


def on_line(distance, **changes):
    start, end = map(np.array, LINE)
    along = (end - start) / np.linalg.norm(end - start)
    x, y = start + distance * along
    return thing(x=x, y=y, z=0.0, **changes)


def test_a_sorted_line():
    objects = [on_line(0.1 + 0.15 * i, height=0.08 + 0.03 * i) for i in range(4)]
    assert judge_sort(objects, *LINE) == [""] * 4


def test_order_counts_from_three_millimetres_on():
    alike = [on_line(0.1, height=0.102), on_line(0.3, height=0.100)]
    assert judge_sort(alike, *LINE) == ["", ""]
    swapped = [on_line(0.1, height=0.12), on_line(0.3, height=0.10), on_line(0.5, height=0.15)]
    assert judge_sort(swapped, *LINE).count("out of order by size") == 1


def test_off_the_line():
    aside = on_line(0.3)
    T = np.array(aside.T_world_object)
    T[:2, 3] += 0.035 * np.array([0.466, 0.885])  # the line's normal
    aside = replace(aside, T_world_object=T)
    assert judge_sort([on_line(0.1), aside], *LINE) == ["", "off the line by 3.5 cm"]
    assert judge_sort([on_line(-0.1)], *LINE) == ["off the line by 10.0 cm"]
