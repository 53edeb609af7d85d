"""What planning takes the scene for, while objects move and while some are thought away."""

import gc
import itertools
import weakref

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manipulation.collision import CollisionConfig
from manipulation.grasp_config import GraspConfig
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE
from manipulation.planning_scene import PlanningScene
from manipulation.standing import to_standing
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle

CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


@pytest.fixture(scope="module")
def items(shapes):
    estimates = [
        shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25),
        shapes.estimate(2, "bowl", shapes.bowl(0.075, slope=0.3), x=0.3, y=-0.4),
        shapes.estimate(3, "bowl", shapes.bowl(0.055, 0.045, slope=0.3), x=0.6, y=-0.4),
    ]
    return {item.name: item for item in map(to_standing, estimates)}


@pytest.fixture(scope="module")
def scene_of(arm):
    config = GraspConfig(n_azimuths=4, top_depths=(0.02,))
    return lambda items, grasps=None: PlanningScene(arm, items, (TABLE,), CollisionConfig(), config, grasps)


@pytest.fixture(scope="module")
def posture(arm):
    """Return the posture with the hand upside down at a position."""
    kinematics = Kinematics(arm)

    def at(x, y, z):
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = x, y, z
        return kinematics.inverse(T, kinematics.seeds_toward(T)).q

    return at


def test_a_lying_object_has_grasps_across_its_axis_until_it_stands_again(scene_of, items):
    scene = scene_of(items)
    standing = scene.pose("can_1")
    lying = standing.copy()
    lying[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    scene.moved("can_1", lying)
    grasps = scene.grasps("can_1")
    kinds = [grasp.kind for grasp in grasps.grasps]
    assert kinds[0] == "waist" and set(kinds) == {"waist", "antipodal"}, "horizontal hands first"
    assert scene.grasps("can_1") is grasps
    scene.moved("can_1", standing)
    assert {grasp.kind for grasp in scene.grasps("can_1").grasps} == {"top"}


def test_the_hand_is_above_the_table_where_it_takes_a_leaning_object_and_where_it_sets_it_upright(
    scene_of, items
):
    scene = scene_of(items)
    leaning = scene.pose("can_1").copy()
    leaning[:3, :3] = Rotation.from_euler("x", 25, degrees=True).as_matrix()
    scene.moved("can_1", leaning)
    grasps = scene.keeping_grasps("can_1").grasps
    assert grasps
    for grasp in grasps:
        approach = grasp.T_stand_tcp[:3, 2]
        assert (leaning[:3, :3] @ approach)[2] < 0 and approach[2] < 0


def test_an_object_on_its_side_is_moved_as_it_lies_with_grasps_across_its_axis(scene_of, items):
    scene = scene_of(items)
    lying = scene.pose("can_1").copy()
    lying[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    scene.moved("can_1", lying)
    kept, turning = scene.keeping_grasps("can_1").grasps, scene.grasps("can_1").grasps
    assert kept[0].kind == "waist"
    across = [sum(grasp.kind == "waist" for grasp in grasps) for grasps in (kept, turning)]
    assert across[0] > across[1], "also near its base"


def test_forgotten_objects_are_no_obstacles(scene_of, items, posture):
    scene = scene_of(items)
    q = posture(0.5, -0.25, 0.06)
    assert scene.world.contact(q, 0.08) is not None
    scene.forget("can_1")
    assert scene.world.contact(q, 0.08) is None
    scene.moved("can_1", scene.pose("can_1"))
    assert scene.world.contact(q, 0.08) is not None, "found again"


def test_what_is_planned_without_an_object_leaves_the_scene_as_it_was(scene_of, items, posture):
    scene = scene_of(items)
    scene.forget("bowl_2")
    before, over_can = scene.state, posture(0.5, -0.25, 0.06)
    poses = scene.poses()
    with scene.without(["bowl_2"]):
        assert scene.state == before, "nothing is gone, so that failures are reused"
    with scene.without(["can_1", "bowl_2"]):
        within = scene.state
        assert within != before and list(scene.poses()) == ["bowl_3"]
        assert scene.world.contact(over_can, 0.08) is None
    assert scene.state == before and scene.forgotten == {"bowl_2"}
    assert scene.poses().keys() == poses.keys()
    assert scene.world.contact(over_can, 0.08) is not None
    scene.moved("can_1", poses["can_1"])
    assert scene.state not in (before, within), "failures without an object are not reused"


def test_what_is_planned_with_an_object_elsewhere_leaves_the_scene_as_it_was(scene_of, items, posture):
    scene = scene_of(items)
    before, T_before = scene.state, scene.poses()["can_1"]
    T = pose_from_yaw(0.0, np.array([0.5, 0.1, 0.0]))
    over_can, over_other = posture(0.5, -0.25, 0.06), posture(0.5, 0.1, 0.06)
    with scene.supposing("can_1", T):
        assert scene.state != before
        np.testing.assert_array_equal(scene.poses()["can_1"], T)
        assert scene.world.contact(over_can, 0.08) is None
        assert scene.world.contact(over_other, 0.08) is not None
    assert scene.state == before
    np.testing.assert_array_equal(scene.poses()["can_1"], T_before)
    assert scene.world.contact(over_can, 0.08) is not None
    assert scene.world.contact(over_other, 0.08) is None


def test_new_obstacles_replace_the_perceived_ones_and_leave_the_objects(scene_of, items, posture):
    scene = scene_of(items)
    above, over_can = posture(0.5, 0.1, 0.1), posture(0.5, -0.25, 0.06)
    scene.forget("can_1")
    thing = PerceivedObstacle(1, (np.array([0.5, 0.1, 0.1]) + 0.04 * CORNERS,), 500)
    scene.observe_obstacles([thing])
    assert scene.world.contact(above, 0.08) is not None
    assert scene.world.contact(over_can, 0.08) is None, "what was forgotten stays so"
    scene.observe_obstacles([])
    assert scene.world.contact(above, 0.08) is None


def test_known_grasps_are_used(scene_of, items):
    known = scene_of(items).grasps("can_1")
    scene = scene_of(items, {"can_1": known})
    assert scene.grasps("can_1") is known


def test_what_is_known_of_a_state_ends_with_it(scene_of, items):
    scene = scene_of(items)
    known = weakref.WeakKeyDictionary({scene.state: "failed"})
    with scene.without(["can_1"]):
        assert scene.state not in known
    assert known[scene.state] == "failed"
    scene.moved("can_1", scene.pose("can_1"))
    gc.collect()
    assert not known
