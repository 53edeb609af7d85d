"""Objects lying, upside down and stacked: counts, resting poses, repeatability, refusals."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from sim_assets.cell import arrangement
from sim_assets.cell.arrangement import Arrangement, _Assignment, _Finder, arrange, rest_unknown
from sim_assets.cell.layout import ArrangementError, UnstableError
from sim_assets.cell.resting import Settled, tilt
from sim_assets.cell.unknown import UnknownThing, draw_unknown
from sim_assets.objects import sample_object
from sim_assets.objects.convex.pieces import hull


@pytest.fixture(scope="module")
def models():
    rng = np.random.default_rng(4)
    return [sample_object(category, "test", rng) for category in ("bottle", "can", "can", "can", "mug")]


@pytest.fixture(scope="module")
def groups(models):
    return arrange(models, Arrangement(lying=1, upside_down=1, stacked=1), np.random.default_rng(0))


def test_every_object_is_in_one_group(groups, models):
    assert sorted(i for group in groups for i in group.Ts_group_object) == list(range(len(models)))


def test_the_numbers_asked_for_rest_that_way(groups):
    single = [T for g in groups if len(g.Ts_group_object) == 1 for T in g.Ts_group_object.values()]
    tilts = sorted(np.rad2deg(tilt(T)) for T in single if T is not None)
    assert (
        len(tilts) == 2 and tilts[0] == pytest.approx(90, abs=30) and tilts[1] == pytest.approx(180, abs=15)
    )
    (stack,) = (g for g in groups if len(g.Ts_group_object) == 2)
    heights = sorted(T[2, 3] for T in stack.Ts_group_object.values())
    assert heights[0] == pytest.approx(0, abs=1e-6) and heights[1] > 0.005


def test_groups_lie_on_the_table_about_their_origin(groups):
    for group in groups:
        assert group.mesh.bounds[0, 2] == pytest.approx(0, abs=2e-3)
        if all(T is not None for T in group.Ts_group_object.values()):
            np.testing.assert_allclose(group.mesh.bounds[:, :2].mean(axis=0), 0, atol=1e-9)


def test_all_upright_by_default(models):
    groups = arrange(models, Arrangement(), np.random.default_rng(0))
    assert [group.Ts_group_object for group in groups] == [{i: None} for i in range(len(models))]


def test_impossible_numbers_name_the_option(models):
    with pytest.raises(
        ArrangementError, match=r"--lying 2: only 1 of these objects rest that way; use other"
    ):
        arrange(models[:1], Arrangement(lying=2), np.random.default_rng(0))
    with pytest.raises(ArrangementError, match=r"--stacked 1: only 0 of these objects stand on others"):
        arrange(models[:1], Arrangement(stacked=1), np.random.default_rng(0))


def test_fewer_are_accepted_if_asked(models):
    groups = arrange(models[:2], Arrangement(lying=2, stacked=1, at_most=True), np.random.default_rng(0))
    tilts = [np.rad2deg(tilt(T)) for g in groups for T in g.Ts_group_object.values() if T is not None]
    assert len(groups) == 2 and tilts == pytest.approx([90, 90], abs=30)


class Table(_Finder):
    """Stands in for the simulated resting poses: which objects lie, and which pairs stack."""

    def __init__(self, lying, pairs, count, overturned=()):
        self.models = [
            SimpleNamespace(mesh=trimesh.creation.box((0.1, 0.1, 0.1)), radius=0.05) for _ in range(count)
        ]
        self.lying = lambda index: np.eye(4) if index in lying else None
        self.upside_down = lambda index: np.eye(4) if index in overturned else None
        self.stack = lambda above, below: np.eye(4) if (above, below) in pairs else None


@pytest.mark.parametrize("seed", range(8))
def test_the_only_assignment_is_found(seed):
    """Object 0 alone stands on 1, and 3 on 2; of those that lie, only 4 and 5 remain for that."""
    table = Table(lying={0, 1, 2, 3, 4, 5}, pairs={(0, 1), (3, 2)}, count=7)
    wanted = Arrangement(lying=2, stacked=2)
    groups = _Assignment(table, wanted, np.random.default_rng(seed), math.inf).groups()
    members = sorted(tuple(sorted(group.Ts_group_object)) for group in groups)
    assert members == [(0, 1), (2, 3), (4,), (5,), (6,)]
    lying = {
        i
        for g in groups
        for i, T in g.Ts_group_object.items()
        if T is not None and len(g.Ts_group_object) == 1
    }
    assert lying == {4, 5}


@pytest.mark.parametrize("seed", range(4))
def test_what_the_hand_opens_around_stands_on_its_rim_first(seed):
    table = Table(lying=(), pairs=set(), count=4, overturned=range(4))
    table.models[2].radius = 0.03
    for count, expected in ((1, {2}), (4, {0, 1, 2, 3})):
        rng = np.random.default_rng(seed)
        groups = _Assignment(table, Arrangement(upside_down=count), rng, 0.072).groups()
        assert {i for g in groups for i, T in g.Ts_group_object.items() if T is not None} == expected


def test_a_hopeless_search_ends():
    table = Table(lying=set(range(12)), pairs=set(), count=12)
    with pytest.raises(ArrangementError, match="--stacked 3: only 0"):
        _Assignment(table, Arrangement(lying=3, stacked=3), np.random.default_rng(0), math.inf).groups()


def test_a_thing_of_no_class_comes_to_rest():
    group = rest_unknown(draw_unknown(1, np.random.default_rng(1))[0], "unknown0")
    assert list(group.Ts_group_object) == [0] and abs(group.mesh.bounds[0, 2]) < 2e-3


def test_an_egg_on_its_tip_lies_down_and_a_carton_stays():
    egg = trimesh.creation.icosphere(3, 0.03).apply_scale((1, 1, 1.6))
    carton = trimesh.creation.box((0.05, 0.05, 0.15))
    tilts = []
    for mesh in (egg, carton):
        mesh.apply_translation((0, 0, -mesh.bounds[0, 2]))
        vertices = np.asarray(mesh.vertices)
        thing = UnknownThing(mesh, (hull(vertices),), 0.1)
        tilts.append(tilt(rest_unknown(thing, "unknown0").Ts_group_object[0]))
    assert abs(tilts[0] - np.pi / 2) < 0.3 and tilts[1] < 0.05


@pytest.mark.parametrize("yaw", [0.0, np.pi / 4, np.pi / 2])
def test_what_balances_on_an_edge_lies_on_a_face(yaw):
    """Of a prism with 18 faces, the next of which are 10 degrees away."""
    prism = trimesh.creation.cylinder(0.03, 0.1, sections=18)
    prism.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    lowest = prism.vertices[np.argmin(prism.vertices[:, 2])]
    prism.apply_transform(
        trimesh.transformations.rotation_matrix(np.arctan2(lowest[0], -lowest[2]), (0, 1, 0))
    )
    prism.apply_transform(trimesh.transformations.rotation_matrix(yaw, (0, 0, 1)))
    prism.apply_translation((0, 0, -prism.bounds[0, 2]))
    vertices = np.asarray(prism.vertices)
    assert (vertices[:, 2] < 1e-4).sum() == 2, "on an edge"
    group = rest_unknown(UnknownThing(prism, (hull(vertices),), 0.1), "unknown0")
    turn = np.rad2deg(tilt(group.Ts_group_object[0]))
    assert turn % 20 == pytest.approx(10, abs=1), "it may roll over several faces"


def test_a_thing_that_does_not_come_to_rest_is_named(monkeypatch):
    """So that another one is drawn in its place."""
    thing = draw_unknown(1, np.random.default_rng(1))[0]
    monkeypatch.setattr(arrangement, "settle", lambda bodies: Settled((np.eye(4),), at_rest=False))
    with pytest.raises(UnstableError, match="unknown2 does not come to rest") as caught:
        rest_unknown(thing, "unknown2")
    assert caught.value.body == "unknown2"
