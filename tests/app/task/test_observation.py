"""Decisions on images: in place, displaced, found or missing, with the fits replaced."""

from dataclasses import replace

import numpy as np
import pytest

import app.task.observation as observation
from app.task.observation import MIN_PIXELS, WristObserver
from manipulation.errors import PlanningError, RobotStoppedError
from manipulation.observation import TURNED
from manipulation.viewpoints import ViewpointScanner
from manipulation.workspace import Workspace
from perception.detection.geometry import points_of
from perception.errors import PerceptionError
from perception.geometry import pose_from_yaw, so3_exp
from perception.inference.pose_search import RefitConfig
from perception.inference.refit import PoseCheck
from perception.obstacles.obstacle import PerceivedObstacle

SEEN = PoseCheck(np.eye(4), "seen", 0.9, MIN_PIXELS, 0.01, 0.0)


class Scanner(ViewpointScanner):
    def __init__(self, frame):
        self.frame, self.visited = frame, []

    def look(self, color=True):
        return self.frame

    def capture(self, viewpoints):
        self.visited.append(tuple(viewpoints))
        return [self.frame]


@pytest.fixture
def scene(overhead_frame, can_at, pack_plan, monkeypatch):
    """An observer of the plan's object, its expected poses, and what the fits will answer."""
    scanner, answers = Scanner(overhead_frame), {"check": SEEN, "found": None}

    def answer(kind, *args, **options):
        if isinstance(answers[kind], Exception):
            raise answers[kind]
        return answers[kind]

    monkeypatch.setattr(observation, "refit_pose", lambda *args, **options: answer("check"))
    monkeypatch.setattr(observation, "refit_leaning", lambda *args: answer("check"))
    monkeypatch.setattr(observation, "relocate", lambda *args, **options: answer("found"))
    watch = WristObserver(scanner, [can_at()], pack_plan.objects)
    poses = {"can_0": pack_plan.objects["can_0"].T_world_stand}
    return watch, poses, answers, scanner


def shifted(can_at, by, **changes):
    T = np.array(can_at().T_world_object)
    T[0, 3] += by
    return replace(SEEN, T_world_object=T, **changes)


def test_a_glance(scene, can_at):
    watch, poses, answers, scanner = scene
    for check, presence in (
        (shifted(can_at, 0.0), "in_place"),
        (shifted(can_at, 0.02), "displaced"),
        (shifted(can_at, 0.02, visible_pixels=MIN_PIXELS - 1), "unseen"),
        (replace(SEEN, status="not_there"), "displaced"),
        (replace(SEEN, status="hidden"), "unseen"),
    ):
        answers["check"] = check
        assert watch.glance(poses, ("can_0",)) == {"can_0": presence}
    assert scanner.visited == []


@pytest.mark.parametrize(("offset", "presence"), [(0.0, "displaced"), (0.28, "displaced"), (0.31, "unseen")])
def test_a_corner_of_an_object_does_not_tell_that_it_has_gone(scene, can_at, offset, presence):
    watch, poses, answers, _ = scene
    T = poses["can_0"].copy()
    T[0, 3] += offset
    for answers["check"], answer in (
        (shifted(can_at, offset), "in_place"),
        (shifted(can_at, offset + 0.02), presence),
    ):
        assert watch.glance({"can_0": T}, ("can_0",)) == {"can_0": answer}


@pytest.mark.parametrize(("moved", "least"), [(0.0, 0.0), (0.1, RefitConfig().min_own)])
def test_only_what_was_moved_must_be_told_from_what_is_below(scene, can_at, monkeypatch, moved, least):
    watch, poses, answers, _ = scene
    T, asked = poses["can_0"].copy(), []
    T[0, 3] += moved
    answers["check"] = shifted(can_at, moved)
    monkeypatch.setattr(
        observation, "refit_pose", lambda *args, config: asked.append(config) or answers["check"]
    )
    assert watch.glance({"can_0": T}, ("can_0",)) == {"can_0": "in_place"}
    assert [config.min_own for config in asked] == [least]


@pytest.mark.parametrize(("category", "presence"), [("can", "in_place"), ("mug", "displaced")])
def test_a_glance_at_what_was_turned(scene, can_at, pack_plan, category, presence):
    """The yaw of a can is arbitrary; the handle of a mug is aligned with others."""
    _, poses, answers, scanner = scene
    items = {"can_0": replace(pack_plan.objects["can_0"], category=category)}
    watch = WristObserver(scanner, [can_at()], items)
    T = can_at().T_world_object @ pose_from_yaw(TURNED + 0.02, np.zeros(3))
    answers["check"] = replace(SEEN, T_world_object=T)
    assert watch.glance(poses, ("can_0",)) == {"can_0": presence}


def test_a_moved_object_is_found_nearby_and_stands_on_its_support(scene, can_at):
    watch, poses, answers, scanner = scene
    answers["check"] = shifted(can_at, 0.02, tilt=0.1)
    finding = watch.find("can_0", poses)
    assert finding.status == "found" and len(scanner.visited) == 1
    np.testing.assert_allclose((finding.T_world_stand - poses["can_0"])[:3, 3], (0.02, 0, 0), atol=1e-9)
    assert finding.T_world_stand[2, 2] == 1.0


def test_what_is_not_nearby_is_searched_for_on_the_table(scene, can_at):
    watch, poses, answers, scanner = scene
    answers["check"] = replace(SEEN, status="not_there")
    assert watch.find("can_0", poses).status == "missing"
    assert scanner.visited[-1] == Workspace().scan_viewpoints(observation.SEARCH_VIEWS)
    lying = pose_from_yaw(0.3, np.array([0.5, -0.3, 0.03]))
    lying[:3, :3] = lying[:3, :3] @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    answers["found"] = replace(SEEN, T_world_object=lying)
    finding = watch.find("can_0", poses)
    np.testing.assert_allclose(finding.T_world_stand[:3, :3], lying[:3, :3], atol=1e-9)
    assert watch.find("can_0", {}).status == "found", "an object without a pose as well"


def test_a_search_is_given_what_else_explains_depth(scene, can_at, pack_plan, monkeypatch):
    _, poses, answers, scanner = scene
    lying = replace(can_at(), id=7)  # not in the plan
    thing = PerceivedObstacle(1, (np.zeros((4, 3)),), 300)
    given = []
    monkeypatch.setattr(observation, "relocate", lambda *args, **options: given.append((args, options)))
    watch = WristObserver(scanner, [can_at(), lying], pack_plan.objects, obstacles=[thing])
    answers["check"] = replace(SEEN, status="not_there")
    assert watch.find("can_0", poses).status == "missing"
    ((_, searched), _) = given[0]
    assert searched.others == [lying] and searched.obstacles == (thing,)


def test_what_was_dropped_is_searched_for_on_the_side_of_the_goals(scene, can_at, pack_plan, monkeypatch):
    _, poses, answers, scanner = scene
    regions, dropped = [], shifted(can_at, 0.1)

    def relocate(estimate, searched, **options):
        regions.append(searched.region)
        return dropped if len(regions) == 2 else None

    monkeypatch.setattr(observation, "relocate", relocate)
    answers["check"] = replace(SEEN, status="not_there")
    views = Workspace(0.8).line_viewpoints
    watch = WristObserver(scanner, [can_at()], pack_plan.objects, Workspace(0.8), goal_views=views)
    assert watch.find("can_0", poses).status == "found" and scanner.visited[-1] == views
    ((_, before), (after, _)) = (region[1] for region in regions)
    assert before == pytest.approx(after), "the regions meet"
    assert regions[1][1][1] == pytest.approx(0.8 * observation.GOAL_REGION[1][1])


def test_what_was_knocked_over_at_its_goal_is_searched_for_there_first(scene, can_at, pack_plan, monkeypatch):
    _, poses, answers, scanner = scene
    regions = []
    monkeypatch.setattr(
        observation, "relocate", lambda _, searched, **options: regions.append(searched.region)
    )
    answers["check"] = replace(SEEN, status="not_there")
    x, y = poses["can_0"][:2, 3]
    views = Workspace().box_viewpoints
    around = ((x - 0.1, x + 0.1), (y - 0.1, y + 0.1))
    watch = WristObserver(scanner, [can_at()], pack_plan.objects, goal_views=views, goal_region=around)
    assert watch.find("can_0", poses).status == "missing"
    assert regions == [around, observation.REGION] and views in scanner.visited
    beside = ((x + 0.1, x + 0.2), (y - 0.1, y + 0.1))
    watch = WristObserver(scanner, [can_at()], pack_plan.objects, goal_views=views, goal_region=beside)
    watch.find("can_0", poses)
    assert regions[2:] == [observation.REGION, beside]


def test_a_search_of_the_table_shows_its_obstacles(scene, can_at, pack_plan):
    _, poses, answers, scanner = scene
    thing, given = PerceivedObstacle(1, (np.zeros((4, 3)),), 300), []

    def find_obstacles(objects, frames):
        given.append([estimate.name for estimate in objects])
        return [thing]

    watch = WristObserver(scanner, [can_at()], pack_plan.objects, find_obstacles=find_obstacles)
    answers["check"] = shifted(can_at, 0.02)
    assert watch.find("can_0", poses).obstacles is None, "found nearby: the table was not seen"
    answers["check"] = replace(SEEN, status="not_there")
    assert watch.find("can_0", poses).obstacles == (thing,)
    answers["found"] = shifted(can_at, 0.3)
    assert watch.find("can_0", poses).obstacles == (thing,)
    answers["check"] = shifted(can_at, 0.02)
    assert watch.find("can_0", poses).obstacles == (thing,), "it may have been among the things before"
    assert given == [[], ["can_0"], ["can_0"]]


def test_things_of_no_class_are_found_in_images_of_the_table(scene, can_at, pack_plan, monkeypatch):
    watch, poses, answers, scanner = scene
    assert watch.find_obstacles(poses) is None and scanner.visited == [], "there is nothing that finds them"
    thing = PerceivedObstacle(1, (np.zeros((4, 3)),), 300)
    watch = WristObserver(scanner, [can_at()], pack_plan.objects, find_obstacles=lambda *_: [thing])
    assert watch.find_obstacles(poses) == (thing,)
    assert scanner.visited == [Workspace().scan_viewpoints(observation.SEARCH_VIEWS)]
    answers["check"] = shifted(can_at, 0.02)
    assert watch.find("can_0", poses).obstacles == (thing,), "some may be parts of what was displaced"

    def unreachable(viewpoints, **options):
        raise PlanningError("out of reach")

    monkeypatch.setattr(scanner, "capture", unreachable)
    assert watch.find_obstacles(poses) is None


def test_a_leaning_object_keeps_its_tilt(scene, can_at):
    """It leans against something: the hand that takes it to be level meets its rim elsewhere."""
    watch, poses, answers, _ = scene
    leaning = {"can_0": poses["can_0"].copy()}
    leaning["can_0"][:3, :3] = so3_exp(np.array([np.deg2rad(16), 0.0, 0.0]))
    T = np.array(can_at().T_world_object)
    T[:3, :3] = so3_exp(np.array([0.4, 0.0, 0.0])) @ T[:3, :3]
    answers["check"] = replace(SEEN, T_world_object=T, tilt=0.4)
    found = watch.find("can_0", leaning)
    assert np.arccos(found.T_world_stand[2, 2]) == pytest.approx(0.4)
    assert watch.find("can_0", poses).status == "missing", "what stood level does not lean by 23 degrees"


def test_points_in_a_region_that_nothing_explains(scene, can_at, pack_plan):
    _, poses, _, scanner = scene
    moved = {"can_0": poses["can_0"].copy()}
    moved["can_0"][0, 3] += 0.05
    thing, given = PerceivedObstacle(1, (np.zeros((4, 3)),), 300), []

    def find_unexplained(points, objects, obstacles):
        given.append((objects[0].T_world_object[0, 3] - can_at().T_world_object[0, 3], obstacles))
        return points[points[:, 0] > middle]

    bystander = replace(can_at(), id=7)
    watch = WristObserver(
        scanner, [can_at(), bystander], pack_plan.objects, find_unexplained=find_unexplained
    )
    shown = points_of(scanner.frame, scanner.frame.depth > 0)
    middle = float(np.median(shown[:, 0]))
    found = watch.unexpected(moved, (thing,), lambda points: points[:, 1] > np.median(shown[:, 1]))
    assert given == [(pytest.approx(0.05), (thing,))]
    assert len(found) and (found[:, 0] > middle).all() and (found[:, 1] > np.median(shown[:, 1])).all()
    nothing = watch.unexpected(moved, (thing,), lambda points: points[:, 2] > 9.0)
    assert nothing.shape == (0, 3) and len(given) == 1


def test_a_stopped_robot_is_no_missing_image(scene):
    watch, poses, answers, _ = scene
    answers["check"] = RobotStoppedError("a person is near")
    with pytest.raises(RobotStoppedError):
        watch.find("can_0", poses)


@pytest.mark.parametrize("error", [PerceptionError("no depth"), PlanningError("out of reach")])
def test_without_images_nothing_is_known(scene, error):
    watch, poses, answers, _ = scene
    answers["check"] = error
    assert watch.find("can_0", poses).status == "unseen"


def test_a_closer_look_keeps_the_tilt_and_gives_each_the_poses_before_it(
    scene, can_at, pack_plan, monkeypatch
):
    watch, poses, answers, scanner = scene
    T = np.array(can_at().T_world_object)
    T[:3, :3] = so3_exp(np.array([0.2, 0.0, 0.0])) @ T[:3, :3]
    answers["check"] = replace(SEEN, T_world_object=T)
    seen = watch.look_closer(["can_0"], poses)
    assert len(scanner.visited) == 1 and np.arccos(seen["can_0"][2, 2]) == pytest.approx(0.2)
    for nothing in (replace(answers["check"], status="not_there"), shifted(can_at, 0.0, visible_pixels=3)):
        answers["check"] = nothing
        assert watch.look_closer(["can_0"], poses) == {}
    answers["check"] = PerceptionError("no depth")
    assert watch.look_closer(["can_0"], poses) == {}
    answers["check"] = RobotStoppedError("a person is near")
    with pytest.raises(RobotStoppedError):
        watch.look_closer(["can_0"], poses)


@pytest.mark.parametrize(("shift", "times"), [(0.005, 1), (0.02, 2)])
def test_a_closer_look_at_several_uses_the_poses_just_found(
    scene, can_at, pack_plan, monkeypatch, shift, times
):
    """Where the lower one was pushed aside, the upper one is fitted again beside its new pose."""
    _, _, _, scanner = scene
    item = pack_plan.objects["can_0"]
    items = {"can_0": item, "can_1": replace(item, id=1)}
    others, standing = [], []

    def refit(estimate, frames, T_expected, near):
        others.append([other.T_world_object[0, 3] for other in near])
        return shifted(can_at, shift)

    def refit_lowest(estimate, *args, config):
        standing.append((estimate.name, config))
        return refit(estimate, *args)

    monkeypatch.setattr(observation, "refit_leaning", refit)
    monkeypatch.setattr(observation, "refit_pose", refit_lowest)
    watch = WristObserver(scanner, [can_at(), replace(can_at(), id=1)], items)
    poses = {name: item.T_world_stand for name in items}
    watch.look_closer(["can_1", "can_0"], poses)
    x = can_at().T_world_object[0, 3]
    np.testing.assert_allclose(others, [[x], *[[x + shift]] * (2 * times - 1)])
    assert standing == [("can_0", observation.STANDING)] * times, "the one below may not lean"


class Handles:
    """Stub of the yaw network."""

    def complete(self, frame, plane, detections):
        return list(detections)


@pytest.mark.parametrize(("turn", "presence"), [(None, "in_place"), (0.5, "displaced"), (0.05, "in_place")])
def test_a_glance_at_a_mugs_handle(scene, can_at, pack_plan, monkeypatch, turn, presence):
    """Depth alone hardly shows where it points: its turn by the fit does not count."""
    _, poses, answers, scanner = scene
    items = {"can_0": replace(pack_plan.objects["can_0"], category="mug")}
    looks = []

    def turned_to_handle(estimate, frames, *_):
        looks.append(len(frames))
        T = estimate.T_world_object @ pose_from_yaw(turn, np.zeros(3)) if turn is not None else None
        return None if T is None else replace(estimate, T_world_object=T)

    monkeypatch.setattr(observation, "turned_to_handle", turned_to_handle)
    monkeypatch.setattr(observation, "shows_handle", lambda *_: False)
    drifted = can_at().T_world_object @ pose_from_yaw(0.3, np.zeros(3))
    answers["check"] = replace(SEEN, T_world_object=drifted)
    watch = WristObserver(scanner, [can_at()], items, handles=Handles())
    assert watch.glance(poses, ("can_0",)) == {"can_0": presence} and looks == [1]
    found = watch.find("can_0", poses).T_world_stand
    expected = poses["can_0"] @ pose_from_yaw(turn or 0.0, np.zeros(3))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    without = WristObserver(scanner, [can_at()], items)
    assert without.glance(poses, ("can_0",)) == {"can_0": "displaced"} and len(looks) == 2
    monkeypatch.setattr(observation, "shows_handle", lambda *_: True)
    assert watch.glance(poses, ("can_0",)) == {"can_0": "in_place"}, "depth shows it where it is expected"
    assert len(looks) == 2, "the network is not asked"


@pytest.mark.parametrize(
    ("changes", "is_seen"),
    [({}, True), ({"status": "not_there"}, False), ({"visible_pixels": MIN_PIXELS - 1}, False)],
)
def test_what_is_in_the_hand_is_seen_from_where_the_camera_is(scene, can_at, monkeypatch, changes, is_seen):
    watch, poses, _, scanner = scene
    T_world_tcp, asked = np.diag([1.0, -1.0, -1.0, 1.0]), []

    def refit_held(estimate, frames, T_expected, T_hand, others):
        asked.append((estimate.name, frames, T_expected, T_hand, others))
        return shifted(can_at, 0.008, **changes)

    monkeypatch.setattr(observation, "refit_held", refit_held)
    T_seen = watch.held("can_0", poses, T_world_tcp)
    ((name, frames, T_expected, T_hand, others),) = asked
    assert (name, others) == ("can_0", []) and frames[0] is scanner.frame and T_hand is T_world_tcp
    np.testing.assert_allclose(T_expected, can_at().T_world_object, atol=1e-9)
    assert not scanner.visited
    if not is_seen:
        assert T_seen is None
        return
    np.testing.assert_allclose((T_seen - poses["can_0"])[:3, 3], [0.008, 0.0, 0.0], atol=1e-9)
