"""Places are left in the box for what is below an object and was not seen."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation import planner
from manipulation.grasp_config import GraspConfig
from manipulation.hidden_objects import SHARE, hidden_objects
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
    (hidden,) = hidden_objects(raised, items_of(raised), 0.08)
    assert hidden.name == "hidden_1" and hidden.top == pytest.approx(0.07)
    assert hidden.T_world_stand[:3, 3] == pytest.approx([0.5, -0.2, 0.0], abs=1e-6)
    assert np.ptp(hidden.vertices[:, 0]) == pytest.approx(SHARE * 0.08)


def test_what_rests_on_a_known_object_or_has_no_item_hides_nothing(raised):
    items = items_of(raised)
    assert hidden_objects([replace(raised[0], rests_on=2)], items, 0.08) == []
    assert hidden_objects(raised, {}, 0.08) == []


@pytest.mark.parametrize(("box", "layouts"), [(Box(), 1), (Box(size=(0.175, 0.235, 0.10)), 2)])
def test_a_place_is_left_for_it_where_there_is_room(raised, arm, monkeypatch, box, layouts):
    """In the second box there is room for the two objects alone."""
    packed = []
    whole = planner.pack

    def pack(items, *args):
        packed.append([item.name for item in items])
        assert args[-1] == {"bowl_1": "hidden_1"}  # which comes after the bowl
        return whole(items, *args)

    monkeypatch.setattr(planner, "pack", pack)
    plan = plan_pack(raised, box, arm, CONFIG)
    assert packed == [["bowl_1", "can_2", "hidden_1"], ["bowl_1", "can_2"]][:layouts]
    assert {goal.name for goal in plan.placements} == {"bowl_1", "can_2"} == set(plan.objects)
    assert not plan.left_out
