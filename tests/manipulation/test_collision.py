import numpy as np
import pytest

from manipulation.collision import AllowedContacts, Body, CollisionConfig, CollisionWorld, Contact, densify
from manipulation.errors import ManipulationError
from manipulation.hulls import convex_pieces
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.standing import to_standing
from manipulation.types import Box
from perception.obstacles.obstacle import PerceivedObstacle

WIDTH = 0.08


def above(kinematics, x, y, z):
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, y, z
    result = kinematics.inverse(T, kinematics.seeds_toward(T))
    assert result.converged
    return result.q


def body(shapes, number, category, mesh, x, y):
    item = to_standing(shapes.estimate(number, category, mesh, x=x, y=y))
    return Body(item.name, convex_pieces(item), item.T_world_stand)


@pytest.fixture(scope="module")
def kinematics(arm):
    return Kinematics(arm)


@pytest.fixture
def world(arm, shapes):
    bodies = [
        body(shapes, 1, "can", shapes.can(0.033, 0.12), 0.5, -0.3),
        body(shapes, 2, "bottle", shapes.bottle(0.035, 0.25), 0.5, 0.2),
        body(shapes, 3, "mug", shapes.mug(), 0.35, 0.0),
    ]
    return CollisionWorld(arm, bodies, [TABLE, *box_obstacles(Box(center=(0.4, 0.4)))])


def test_free_space_is_free_and_the_table_is_not(world, kinematics):
    assert world.contact(above(kinematics, 0.5, -0.1, 0.2), WIDTH) is None
    assert world.contact(above(kinematics, 0.5, -0.1, 0.005), WIDTH) == Contact("arm", "table")


def test_robot_keeps_its_margin(arm, kinematics):
    world = CollisionWorld(arm, [], [TABLE], CollisionConfig(robot_margin=0.004))
    # Fingertips reach 9 mm beyond the TCP: .0584 + .054 - .1034.
    assert world.contact(above(kinematics, 0.5, 0.0, 0.0090 + 0.0045), WIDTH) is None
    assert world.contact(above(kinematics, 0.5, 0.0, 0.0090 + 0.0035), WIDTH) == Contact("arm", "table")


def test_hand_in_an_object_is_seen_unless_it_may_touch_it(world, kinematics):
    q = above(kinematics, 0.5, -0.3, 0.06)
    assert world.contact(q, WIDTH) == Contact("arm", "can_1")
    assert world.contact(q, WIDTH, AllowedContacts(touch=frozenset({"can_1"}))) is None


def test_fingers_open_around_a_can_are_free_and_closed_are_not(world, kinematics):
    q = above(kinematics, 0.5, -0.3, 0.1)
    assert world.contact(q, 0.08) is None  # 7 mm between pad and can, more than the margin
    assert world.contact(q, 0.072) == Contact("arm", "can_1")


def test_moved_and_absent_objects(world, kinematics):
    q = above(kinematics, 0.5, -0.3, 0.06)
    T = world.pose("can_1")
    T[0, 3] -= 0.2
    world.move("can_1", T)
    assert world.contact(q, WIDTH) is None
    assert world.contact(above(kinematics, 0.3, -0.3, 0.06), WIDTH) == Contact("arm", "can_1")
    world.set_present("can_1", False)
    assert world.contact(above(kinematics, 0.3, -0.3, 0.06), WIDTH) is None


def test_carried_object_meets_neighbours_with_its_own_margin(world, kinematics):
    T_tcp_stand = np.diag([1.0, -1.0, -1.0, 1.0])
    T_tcp_stand[2, 3] = 0.1  # the can's base is 10 cm below the TCP
    world.carry("can_1", T_tcp_stand)
    assert world.contact(above(kinematics, 0.5, -0.3, 0.2), WIDTH) is None
    q = above(kinematics, 0.5, 0.2 - 0.035 - 0.033 - 0.002, 0.15)
    bottle = frozenset({"bottle_2"})
    assert world.contact(q, 0.06, AllowedContacts(bottle, carried_margin=0.004)) == Contact(
        "can_1", "bottle_2"
    )
    assert world.contact(q, 0.06, AllowedContacts(bottle, carried_margin=0.0)) is None
    assert world.contact(q, 0.06, AllowedContacts(bottle, touch_carried=bottle)) is None
    low = above(kinematics, 0.5, -0.3, 0.1)
    assert world.contact(low, 0.06) == Contact("can_1", "table")
    world.release()
    assert world.contact(above(kinematics, 0.5, -0.3, 0.06), WIDTH) == Contact("arm", "can_1")


@pytest.mark.parametrize(("overlap", "slides"), [(-0.001, True), (0.0015, True), (0.006, False)])
def test_a_carried_object_slides_along_what_it_touches_but_not_into_it(world, kinematics, overlap, slides):
    T_tcp_stand = np.diag([1.0, -1.0, -1.0, 1.0])
    T_tcp_stand[2, 3] = 0.1
    world.carry("can_1", T_tcp_stand)
    q = above(kinematics, 0.5, 0.2 - 0.035 - 0.033 + overlap, 0.15)
    bottle = frozenset({"bottle_2"})
    found = world.contact(q, 0.06, AllowedContacts(bottle, slide_carried={"bottle_2": 0.002}))
    depth = world.carried_overlaps(q, 0.06)["bottle_2"]
    world.release()
    assert depth == pytest.approx(overlap, abs=5e-4)
    assert found == (None if slides else Contact("can_1", "bottle_2"))


def test_path_through_a_bottle_is_blocked_though_its_ends_are_free(world, kinematics):
    start, end = above(kinematics, 0.5, -0.05, 0.15), above(kinematics, 0.42, 0.42, 0.15)
    assert world.contact(start, WIDTH) is None and world.contact(end, WIDTH) is None
    assert world.path_contact(np.stack([start, end]), WIDTH) == Contact("arm", "bottle_2")


def test_densify_keeps_the_ends_and_the_step():
    path = densify(np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.31]]), 0.05)
    assert np.abs(np.diff(path, axis=0)).max() <= 0.05 + 1e-12
    assert path[0] == pytest.approx([0, 0]) and path[-1] == pytest.approx([0.1, 0.31])


def test_unknown_names_are_errors(world):
    with pytest.raises(ManipulationError, match=r"no object 'mug_9'.*can_1, bottle_2, mug_3"):
        world.move("mug_9", np.eye(4))


def test_the_carried_object_is_checked_with_the_configured_margin(arm, shapes, kinematics):
    """The can's base is 10 cm below the TCP: 3 mm above the table it is within a margin of 4 mm."""
    bodies = [body(shapes, 1, "can", shapes.can(0.033, 0.12), 0.5, -0.3)]
    world = CollisionWorld(arm, bodies, [TABLE], CollisionConfig(carried_margin=0.004))
    T_tcp_stand = np.diag([1.0, -1.0, -1.0, 1.0])
    T_tcp_stand[2, 3] = 0.1
    world.carry("can_1", T_tcp_stand)
    assert world.contact(above(kinematics, 0.5, 0.0, 0.1035), 0.06) == Contact("can_1", "table")
    assert world.contact(above(kinematics, 0.5, 0.0, 0.1045), 0.06) is None


def test_carrying_another_object_returns_the_first_to_its_last_pose(world, kinematics):
    world.carry("can_1", np.eye(4))
    world.carry("bottle_2", np.eye(4))
    np.testing.assert_allclose(world.pose("can_1")[:3, 3], (0.5, -0.3, 0.0), atol=1e-3)
    world.release()
    assert world.contact(above(kinematics, 0.5, -0.3, 0.06), WIDTH) == Contact("arm", "can_1")


def test_contents_are_carried_with_what_holds_them(world, kinematics):
    """The mug is 0.15 m before and 0.3 m beside the can, and remains there."""
    T_tcp_stand = np.diag([1.0, -1.0, -1.0, 1.0])
    T_tcp_stand[2, 3] = 0.1
    q = above(kinematics, 0.5 + 0.15, 0.2 - 0.3, 0.15)  # the mug is where the bottle stands
    with world.containing("can_1", ["mug_3"]):
        world.carry("can_1", T_tcp_stand)
        hit = world.contact(q, 0.06)
        assert hit is not None and hit.mover == "mug_3"
        assert "bottle_2" in world.carried_overlaps(q, 0.06)
    assert world.contact(above(kinematics, 0.35, 0.0, 0.06), WIDTH) == Contact("arm", "mug_3")
    world.carry("can_1", T_tcp_stand)
    assert world.contact(q, 0.06) is None


def block(low, high):
    return np.array(
        [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


@pytest.fixture(scope="module")
def thing():
    """A thing of two pieces at (0.5, -0.3) m, 12 cm high."""
    pieces = (block((0.47, -0.33, 0.0), (0.53, -0.27, 0.06)), block((0.49, -0.31, 0.05), (0.51, -0.29, 0.12)))
    return PerceivedObstacle(2, pieces, 1000)


def test_a_perceived_thing_blocks_hand_and_carried_object(arm, shapes, kinematics, thing):
    can = body(shapes, 1, "can", shapes.can(0.033, 0.12), 0.5, 0.2)
    world = CollisionWorld(arm, [can], [TABLE, thing])
    assert world.contact(above(kinematics, 0.5, -0.3, 0.10), 0.0) == Contact("arm", "thing_2")
    assert world.contact(above(kinematics, 0.5, -0.3, 0.25), 0.0) is None
    hanging = np.eye(4)
    hanging[:3, :3] = np.diag([1.0, -1.0, -1.0])
    hanging[2, 3] = 0.10  # the can's base, 10 cm below the TCP
    over, q_goal = above(kinematics, 0.5, -0.3, 0.21), above(kinematics, 0.5, 0.1, 0.21)
    assert world.contact(over, 0.066, AllowedContacts(touch=frozenset({"can_1"}))) is None
    world.carry("can_1", hanging)
    assert world.contact(over, 0.066) == Contact("can_1", "thing_2")
    assert world.path_contact(np.stack([over, q_goal]), 0.066) == Contact("can_1", "thing_2")
    assert world.contact(q_goal, 0.066) is None


def test_a_thing_keeps_a_margin_of_its_own(arm, kinematics):
    """Fingertips reach 9 mm beyond the TCP."""
    plate = PerceivedObstacle(0, (block((0.4, -0.4, 0.0), (0.6, -0.2, 0.06)),), 1000)
    world = CollisionWorld(arm, [], [TABLE, plate], CollisionConfig(robot_margin=0.0, perceived_margin=0.004))
    assert world.contact(above(kinematics, 0.5, -0.3, 0.06 + 0.009 + 0.0045), WIDTH) is None
    assert world.contact(above(kinematics, 0.5, -0.3, 0.06 + 0.009 + 0.0035), WIDTH) == Contact(
        "arm", "thing_0"
    )


def test_links_are_those_that_the_pose_of_the_hand_leaves_free(world):
    assert {"link1", "link5", "link6"} <= world.links
    assert not {"link7", "hand", "left_finger", "right_finger"} & world.links
