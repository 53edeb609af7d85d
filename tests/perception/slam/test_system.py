"""The whole system on cylinders: it maps, tracks, says that it is lost, finds itself, and lets go."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference.fit import FitConfig, FitStage
from perception.io.recordings.sequence import without_pose
from perception.slam.config import LifeConfig, SlamConfig
from perception.slam.initialise import touches_border
from perception.slam.pixels import label_image
from perception.slam.relocalise import level_camera, relocalise
from perception.slam.system import Slam, joined_labels
from perception.types import RgbdFrame, SupportPlane

QUICK = FitConfig(stages=(FitStage(32, 1, 5), FitStage(40, 0, 6)))


class Recording:
    """Frames along a slow orbit, with what each shows."""

    def __init__(self, cylinders, scenes, count=8, step=1.2) -> None:
        self.truth = [scenes.orbit((0, 0.03, 0.03), 0.55, 45, 20 + step * k) for k in range(count)]
        looks = [cylinders.look(T, noise=0.001) for T in self.truth]
        self.frames = [
            RgbdFrame(k / 30, frame.rgb, frame.depth, frame.intrinsics, frame.T_world_camera)
            for k, (frame, _, _) in enumerate(looks)
        ]
        self.detections = [found for _, found, _ in looks]

    def slam(self, decoder, config=None) -> Slam:
        self.at = 0
        return Slam(decoder, lambda frame, plane: self.detections[self.at], config or SlamConfig(fit=QUICK))

    def feed(self, slam, number, frame=None):
        self.at = number
        return slam.process(self.frames[number] if frame is None else frame)

    def error(self, result, number) -> float:
        return float(np.linalg.norm(result.T_world_camera[:3, 3] - self.truth[number][:3, 3]))


@pytest.fixture(scope="module")
def recording(cylinders, scenes):
    return Recording(cylinders, scenes)


@pytest.fixture
def mapped(recording, cylinders):
    """A system that has seen the first frame."""
    slam = recording.slam(cylinders.decoder)
    return slam, recording.feed(slam, 0)


def test_first_frame_makes_the_map(mapped, cylinders):
    slam, result = mapped
    assert result.keyframe and result.status == "tracked" and len(result.new) == 5
    for landmark in slam.world.landmarks.values():
        places = np.array([place[:2] for place in cylinders.places])
        distance = np.linalg.norm(places - landmark.state.pose.translation[:2], axis=1)
        assert distance.min() < 0.004


def test_tracks_without_looking_at_the_recorded_poses(mapped, recording):
    slam, _ = mapped
    for number in range(1, 6):
        wrong = np.array(recording.truth[0])
        wrong[:3, 3] += number  # what the recording says is nonsense
        frame = recording.frames[number]
        lie = RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics, wrong)
        result = recording.feed(slam, number, lie)
        assert result.status == "tracked" and recording.error(result, number) < 0.003
    assert len(slam.world.ids) == 5 and not result.new


def test_a_dark_moment_is_survived_and_the_map_stays(mapped, recording):
    slam, _ = mapped
    recording.feed(slam, 1, without_pose(recording.frames[1]))
    before = slam.world
    frame = recording.frames[2]
    dark = RgbdFrame(frame.time, frame.rgb, np.zeros_like(frame.depth), frame.intrinsics)
    assert recording.feed(slam, 2, dark).status == "lost"
    assert slam.world is before
    result = recording.feed(slam, 4, without_pose(recording.frames[4]))
    assert result.status == "tracked" and recording.error(result, 4) < 0.004


def test_a_gap_in_time_carries_the_motion_on(mapped, recording):
    slam, _ = mapped
    for number in (1, 2, 6):
        result = recording.feed(slam, number, without_pose(recording.frames[number]))
    assert result.status == "tracked" and recording.error(result, 6) < 0.003


def test_what_is_gone_is_retired(mapped, recording):
    slam, first = mapped
    life = replace(slam.config.life, check_every=1, max_misses=2)
    slam.config = slam.mapper.config = replace(slam.config, life=life)
    gone = first.landmark_of[1]
    kept, recording.detections = recording.detections, [found[1:] for found in recording.detections]
    results = [recording.feed(slam, n, without_pose(recording.frames[n])) for n in range(1, 6)]
    recording.detections = kept
    assert gone in [one for result in results for one in result.retired]
    assert gone not in slam.world.ids and len(slam.world.ids) == 4


def test_an_object_moved_by_hand_leaves_no_double(cylinders, scenes):
    moved = replace(cylinders, places=(*cylinders.places[:-1], (-0.16, -0.02, 0.033)))
    before, after = Recording(cylinders, scenes, count=2), Recording(moved, scenes, count=16, step=1.2)
    slam = before.slam(cylinders.decoder)
    before.feed(slam, 0), before.feed(slam, 1, without_pose(before.frames[1]))
    slam.detect = lambda frame, plane: after.detections[after.at]
    results = [after.feed(slam, n, without_pose(after.frames[n])) for n in range(2, 16)]
    assert all(result.status == "tracked" for result in results)
    assert max(after.error(result, n) for n, result in enumerate(results, start=2)) < 0.004
    places = np.array([one.state.pose.translation[:2] for one in slam.world.landmarks.values()])
    assert len(places) == 5
    for x, y, _ in moved.places:
        assert np.linalg.norm(places - (x, y), axis=1).min() < 0.006


def test_an_object_pushed_aside_is_fitted_where_it_stands_now(cylinders, scenes):
    """Nearer than where its own masks could be another's: the same landmark, its older views forgotten."""
    pushed = replace(cylinders, places=(*cylinders.places[:-1], (-0.135, -0.16, 0.033)))
    before, after = Recording(cylinders, scenes, count=2), Recording(pushed, scenes, count=16)
    slam = before.slam(cylinders.decoder, SlamConfig(fit=QUICK, life=LifeConfig(retry=4)))
    first = before.feed(slam, 0)
    before.feed(slam, 1, without_pose(before.frames[1]))
    slam.detect = lambda frame, plane: after.detections[after.at]
    results = [after.feed(slam, n, without_pose(after.frames[n])) for n in range(2, 12)]
    assert all(result.status == "tracked" for result in results)
    assert max(after.error(result, n) for n, result in enumerate(results, start=2)) < 0.004
    assert slam.world.ids == tuple(sorted(first.new))
    places = {one: mark.state.pose.translation[:2] for one, mark in slam.world.landmarks.items()}
    (one,) = (k for k, place in places.items() if np.linalg.norm(place - pushed.places[-1][:2]) < 0.006)
    assert all(one not in key.landmarks for key in slam.keyframes if key.number < 2)
    for x, y, _ in cylinders.places[:-1]:
        assert min(np.linalg.norm(place - (x, y)) for place in places.values()) < 0.004


def test_cut_objects_wait_while_others_hold_the_camera(mapped, recording):
    slam, first = mapped
    mapper, frame = slam.mapper, recording.frames[1]
    mapper.world = mapper.world.without(set(first.new[:1]))
    mask = np.array(recording.detections[1][0].mask)
    mask[0, :5] = True
    cut = replace(recording.detections[1][0], mask=mask)
    mapper.unmatched = [(cut.mask, 2)]
    posed = RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics, recording.truth[1])
    assert mapper.holds({one: 0.9 for one in mapper.world.ids})
    assert mapper.new_landmarks(posed, [cut], {}, True, 1) == {}
    assert touches_border(cut)
    whole = recording.detections[1][0]
    mapper.unmatched = [(whole.mask, 2)]
    assert len(mapper.new_landmarks(posed, [whole], {}, True, 1)) == 1


def test_a_weak_pose_gets_new_landmarks_that_share_its_doubt(recording, cylinders):
    slam = recording.slam(cylinders.decoder, SlamConfig(fit=QUICK, life=LifeConfig(weak_spread=0.0)))
    first = recording.feed(slam, 0)
    slam.mapper.world, slam.mapper.unmatched = slam.mapper.world.without(set(first.new[:1])), []
    results = [recording.feed(slam, number) for number in (1, 2, 3)]
    assert {result.status for result in results} == {"weak"}
    (new,) = (one for result in results for one in result.new)
    old = slam.world.landmarks[first.new[1]]
    assert np.trace(slam.world.landmarks[new].doubt[3:, 3:]) > np.trace(old.doubt[3:, 3:])


def test_a_pose_that_hangs_on_one_object_is_soon_no_longer_stood_by(cylinders, scenes):
    """One cylinder says nothing of a turn about its axis: what the motion does not know in time is lost."""
    recording = Recording(cylinders, scenes, count=20)
    slam = recording.slam(cylinders.decoder)
    assert [recording.feed(slam, n).status for n in range(4)] == 4 * ["tracked"]
    kept, recording.detections = recording.detections, [found[:1] for found in recording.detections]
    results = [recording.feed(slam, n, without_pose(recording.frames[n])) for n in range(4, 18)]
    spreads = [result.spread for result in results]
    frozen, status = slam.world, [result.status for result in results]
    assert status[0] != "lost" and status[-1] == "lost" and spreads[-1] > spreads[0]
    for n, result in enumerate(results, start=4):
        assert result.status == "lost" or recording.error(result, n) < 0.02
    recording.detections = kept
    back = recording.feed(slam, 18, without_pose(recording.frames[18]))
    assert back.status == "tracked" and recording.error(back, 18) < 0.004
    assert slam.world.ids == frozen.ids


def test_relocalises_from_nowhere(cylinders, scenes):
    world = cylinders.map()
    config = SlamConfig()
    T = scenes.orbit((0, 0.03, 0.03), 0.6, 50, 200)
    frame, detections, _ = cylinders.look(T)
    labels = label_image(detections, frame.depth.shape)
    found = relocalise(
        world,
        without_pose(frame),
        detections,
        labels,
        config.tracking,
        config.selection,
        config.relocalisation,
    )
    assert found is not None
    assert np.linalg.norm(found.tracked.T_world_camera[:3, 3] - T[:3, 3]) < 0.005


def test_too_few_objects_are_no_place(cylinders, scenes):
    world = cylinders.map().without({0, 1, 2})
    frame, detections, _ = cylinders.look(scenes.orbit((0, 0.03, 0.03), 0.6, 50, 200))
    labels, config = label_image(detections, frame.depth.shape), SlamConfig()
    args = (config.tracking, config.selection, config.relocalisation)
    assert relocalise(world, without_pose(frame), detections, labels, *args) is None


def test_level_camera_lays_the_plane_flat():
    normal = np.array([0.2, -0.5, 0.7])
    plane = SupportPlane(normal / np.linalg.norm(normal), 0.3)
    T = level_camera(plane)
    on_plane = plane.normal * plane.offset + np.cross(plane.normal, [0.3, 0.1, -0.4])
    assert (T @ [*on_plane, 1])[2] == pytest.approx(0)
    assert (T @ [*(on_plane + 0.1 * plane.normal), 1])[2] == pytest.approx(0.1)


def test_labels_of_one_landmark_become_one():
    labels = np.array([[0, 1, 2], [3, 3, 2]], np.uint8)
    joined, landmark_of = joined_labels(labels, {1: 7, 2: 9, 3: 7})
    assert joined.tolist() == [[0, 1, 2], [1, 1, 2]] and landmark_of == {1: 7, 2: 9}
