"""Places are left in the box for what is below an object and was not seen."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.grasp_config import GraspConfig
from manipulation.hidden_objects import RADIUS, hidden_objects
from manipulation.packing_problem import PackingConfig
from manipulation.pick_place import PickPlaceConfig
from manipulation.planner import ManipulationConfig, plan_pack
from manipulation.standing import to_standing
from manipulation.types import Box

# Coarser than the defaults, for speed alone.
CONFIG = ManipulationConfig(
    pick_place=PickPlaceConfig(grasp=GraspConfig(n_azimuths=8, top_depths=(0.02, 0.03))),
    packing=PackingConfig(gaps=(0.012,), n_handle_directions=2),
)


@pytest.fixture(scope="module")
def raised(shapes):
    """A bowl 7 cm above the table, and a can on it."""
    return [
        shapes.estimate(1, "bowl", shapes.bowl(), x=0.5, y=-0.2, lift=0.07),
        shapes.estimate(2, "can", shapes.can(), x=0.4, y=-0.35),
    ]


def items_of(objects):
    return {item.name: item for item in map(to_standing, objects)}


def test_below_an_object_above_the_table_is_something_as_high_as_its_base(raised):
    (hidden,) = hidden_objects(raised, items_of(raised))
    assert hidden.name == "hidden_1" and hidden.top == pytest.approx(0.07)
    assert hidden.T_world_stand[:3, 3] == pytest.approx([0.5, -0.2, 0.0], abs=1e-6)
    assert np.ptp(hidden.vertices[:, 0]) == pytest.approx(2 * RADIUS)


def test_what_rests_on_a_known_object_or_has_no_item_hides_nothing(raised):
    items = items_of(raised)
    assert hidden_objects([replace(raised[0], rests_on=2)], items) == []
    assert hidden_objects(raised, {}) == []


def test_a_place_is_left_for_it_where_there_is_room(raised, arm):
    """In the second box there is room for the two objects alone."""
    wide = plan_pack(raised, Box(), arm, CONFIG)
    assert {goal.name for goal in wide.placements} == {"bowl_1", "can_2"} and not wide.left_out
    tight = Box(size=(0.18, 0.26, 0.10))
    narrow = plan_pack(raised, tight, arm, CONFIG)
    assert {goal.name for goal in narrow.placements} == {"bowl_1", "can_2"}


def test_the_place_is_free(raised, arm, monkeypatch):
    """The goals are those of a layout of three objects."""
    from manipulation import planner

    packed = []
    whole = planner.pack

    def pack(items, *args):
        packed.append([item.name for item in items])
        return whole(items, *args)

    monkeypatch.setattr(planner, "pack", pack)
    plan = plan_pack(raised, Box(), arm, CONFIG)
    assert packed == [["bowl_1", "can_2", "hidden_1"]] and "hidden_1" not in plan.objects
