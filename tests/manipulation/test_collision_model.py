import numpy as np
import pytest

from manipulation.collision_model import OFF, ROBOT, WORLD, Body, collision_model
from manipulation.hulls import convex_pieces
from manipulation.obstacles import TABLE
from manipulation.self_collision import link_contacts
from manipulation.standing import to_standing
from perception.obstacles.obstacle import PerceivedObstacle

CUBE = np.stack(np.meshgrid([0.0, 0.1], [0.0, 0.1], [0.0, 0.1]), -1).reshape(-1, 3)


@pytest.fixture(scope="module")
def model(arm, shapes):
    can = to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5))
    bodies = [Body("can_1", convex_pieces(can), can.T_world_stand)]
    thing = PerceivedObstacle(0, (CUBE, CUBE + 0.2), 10)
    return collision_model(arm, bodies, (TABLE, thing), perceived_margin=0.003).compile()


def geoms(model, body):
    return np.flatnonzero(model.geom_bodyid == model.body(body).id)


def bits(model, body):
    of = geoms(model, body)
    return set(zip(model.geom_contype[of].tolist(), model.geom_conaffinity[of].tolist(), strict=True))


def test_an_object_is_in_the_world_and_its_copy_in_the_hand_is_disabled(model):
    assert bits(model, "world/can_1") == {(WORLD, ROBOT)}
    assert bits(model, "carried/can_1") == {(OFF, OFF)}
    assert model.body_parentid[model.body("carried/can_1").id] == model.body("hand").id


def test_a_thing_has_a_geom_for_each_piece_with_its_margin(model):
    of = geoms(model, "world/thing_0")
    assert len(of) == 2 and (model.geom_margin[of] == 0.003).all()
    assert bits(model, "world/thing_0") == {(WORLD, ROBOT)}


def test_links_that_turn_about_the_vertical_alone_are_not_checked_against_the_table(model, arm):
    table = model.body(f"world/{TABLE.name}").id
    excluded = {(first, second) for first, second in ((s >> 16, s & 0xFFFF) for s in model.exclude_signature)}
    level = {model.body(link).id for link in link_contacts(arm).level}
    assert level and all((link, table) in excluded or (table, link) in excluded for link in level)


def test_the_base_meets_links_but_not_what_it_stands_on(model):
    ((base,), (hand,)) = bits(model, "base"), bits(model, "hand")
    assert not base[0] & WORLD and not base[1] & WORLD and base[0] & hand[1]
    assert hand[0] & ROBOT and hand[1] & WORLD
