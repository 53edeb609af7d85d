"""The planner's world follows what an observer sees."""

import numpy as np
import pytest

from manipulation.kinematics import Kinematics
from manipulation.observation import Finding
from manipulation.pick_place import PickPlacePlanner
from manipulation.scene_following import BESIDE, SceneFollowing, Searched
from manipulation.standing import to_standing
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle
from tests.manipulation.test_execution import CONFIG

X = {"can_1": 0.4, "can_2": 0.4 + 0.9 * BESIDE, "can_3": 0.4 + 1.8 * BESIDE}


class Observer:
    """Sees ``seen``; ``displaced`` are the objects that a glance finds elsewhere."""

    def __init__(self):
        self.seen, self.displaced, self.glanced, self.obstacles = {}, set(), (), None

    def glance(self, poses, names):
        self.glanced = names
        return {name: "displaced" if name in self.displaced else "in_place" for name in names}

    def unexpected(self, poses, obstacles, region):
        raise AssertionError("not asked for")

    def held(self, name, poses, T_world_tcp):
        raise AssertionError("not asked for")

    def find(self, name, poses):
        return self.seen.get(name, Finding("unseen"))

    def find_obstacles(self, poses):
        return self.obstacles

    def look_closer(self, names, poses):
        return {}


@pytest.fixture
def planner(shapes, arm):
    items = {
        name: to_standing(shapes.estimate(number, "can", shapes.can(), x=x, y=-0.25))
        for number, (name, x) in enumerate(X.items(), 1)
    }
    return PickPlacePlanner(Kinematics(arm), items, config=CONFIG.pick_place)


def test_a_found_object_is_where_it_was_seen(planner):
    observer, T = Observer(), pose_from_yaw(0.3, np.array([0.5, 0.2, 0.0]))
    observer.seen["can_1"] = Finding("found", T)
    assert SceneFollowing(planner.scene, observer).search("can_1") == Searched()
    np.testing.assert_allclose(planner.scene.poses()["can_1"], T)


@pytest.mark.parametrize(("shift", "is_in_place"), [(0.0, True), (0.002, True), (0.05, False)])
def test_an_object_is_in_place_where_it_is_found_as_expected(planner, shift, is_in_place):
    observer, T = Observer(), planner.scene.poses()["can_1"].copy()
    T[0, 3] += shift
    observer.seen["can_1"] = Finding("found", T)
    assert SceneFollowing(planner.scene, observer).search("can_1").is_in_place is is_in_place


def test_a_missing_object_is_forgotten_and_stays_so_while_it_is_unseen(planner):
    observer = Observer()
    scene = SceneFollowing(planner.scene, observer)
    assert scene.search("can_1") == Searched() and not planner.scene.forgotten, "unseen is not missing"
    observer.seen["can_1"] = Finding("missing")
    assert "taken away or fell off" in scene.search("can_1").problem
    del observer.seen["can_1"]
    assert planner.scene.forgotten == {"can_1"} and "as before" in scene.search("can_1").problem


def test_things_of_no_class_are_looked_for_anew(planner):
    observer = Observer()
    scene = SceneFollowing(planner.scene, observer)
    thing = PerceivedObstacle(0, (np.add(np.eye(4, 3), (0.3, -0.4, 0.0)),), 300)
    planner.scene.observe_obstacles([thing])
    scene.renew_obstacles()
    assert planner.scene.perceived_obstacles == (thing,), "the table could not be seen"
    observer.obstacles = ()
    scene.renew_obstacles()
    assert planner.scene.perceived_obstacles == ()


def test_only_what_was_near_and_is_found_elsewhere_was_pushed(planner):
    observer = Observer()
    observer.displaced = {"can_2", "can_3"}
    T = planner.scene.poses()["can_1"]
    scene = SceneFollowing(planner.scene, observer)
    assert list(scene.displaced_near(T, {"can_1"})) == [] and observer.glanced == ("can_2",), "not found"
    before, T_seen = planner.scene.poses()["can_2"], pose_from_yaw(0.0, np.array([0.7, 0.1, 0.0]))
    observer.seen["can_2"] = Finding("found", T_seen)
    assert list(scene.displaced_near(T, {"can_1", "can_2"})) == [], "what is below it is looked at by others"
    ((name, T_before),) = scene.displaced_near(T, {"can_1"})
    assert name == "can_2"
    np.testing.assert_allclose(T_before, before)
    np.testing.assert_allclose(planner.scene.poses()["can_2"], T_seen)
