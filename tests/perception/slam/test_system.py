"""The system on cylinders: mapping, tracking, loss and recovery, moved and removed objects."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference.fit_config import FitConfig, FitStage
from perception.io.recordings.sequence import without_pose
from perception.slam.config import LandmarkLifecycleConfig, SlamConfig
from perception.slam.detection_schedule import DetectionSchedule, DetectionScheduleConfig
from perception.slam.pose_check import PoseCheckConfig
from perception.slam.stage_timer import StageTimer
from perception.slam.system import Slam
from perception.types import RgbdFrame

FAST_FIT = FitConfig(stages=(FitStage(32, 1, 5), FitStage(40, 0, 6)))
EVERY_FRAME = DetectionScheduleConfig(max_interval=1)


class Recording:
    """Frames along a slow orbit, with their detections."""

    def __init__(self, cylinders, scenes, count=8, step=1.2) -> None:
        self.truth = [scenes.orbit((0, 0.03, 0.03), 0.55, 45, 20 + step * k) for k in range(count)]
        views = [cylinders.look(T, noise=0.001) for T in self.truth]
        self.frames = [
            RgbdFrame(k / 30, frame.rgb, frame.depth, frame.intrinsics, frame.T_world_camera)
            for k, (frame, _, _) in enumerate(views)
        ]
        self.detections = [found for _, found, _ in views]
        self.at = 0

    def slam(self, decoder, config=None) -> Slam:
        self.at = 0
        return Slam(
            decoder, lambda frame, plane: self.detections[self.at], config or SlamConfig(fit=FAST_FIT)
        )

    def feed(self, slam, number, frame=None):
        """Process a frame; all but the first without its pose."""
        self.at = number
        if frame is None:
            frame = self.frames[number] if number == 0 else without_pose(self.frames[number])
        return slam.process(frame)

    def error(self, result, number) -> float:
        return float(np.linalg.norm(result.T_world_camera[:3, 3] - self.truth[number][:3, 3]))


@pytest.fixture(scope="module")
def recording(cylinders, scenes):
    return Recording(cylinders, scenes)


@pytest.fixture
def mapped(recording, cylinders):
    """A system after the first frame, and its result."""
    slam = recording.slam(cylinders.decoder)
    return slam, recording.feed(slam, 0)


def test_the_first_frame_initialises_the_map(mapped, cylinders, recording):
    slam, result = mapped
    assert result.is_keyframe and result.status == "tracked" and len(result.new) == 5
    np.testing.assert_allclose(result.T_world_camera, recording.truth[0], atol=1e-12)
    assert set(result.landmark_of.values()) == set(result.new) == set(slam.world.ids)
    for landmark in slam.world.landmarks.values():
        places = np.array([place[:2] for place in cylinders.places])
        distance = np.linalg.norm(places - landmark.state.pose.translation[:2], axis=1)
        assert distance.min() < 0.004


def test_later_poses_of_the_recording_are_ignored(mapped, recording):
    slam, _ = mapped
    for number in range(1, 6):
        wrong = np.array(recording.truth[0])
        wrong[:3, 3] += number
        frame = replace(recording.frames[number], T_world_camera=wrong)
        result = recording.feed(slam, number, frame)
        assert result.status == "tracked" and recording.error(result, number) < 0.003
    assert len(slam.world.ids) == 5 and not result.new


def test_the_map_survives_a_frame_without_depth(mapped, recording):
    slam, _ = mapped
    recording.feed(slam, 1)
    before = slam.world
    frame = without_pose(recording.frames[2])
    dark = replace(frame, depth=np.zeros_like(frame.depth))
    lost = recording.feed(slam, 2, dark)
    assert lost.status == "lost" and lost.time == frame.time and not lost.landmark_of
    assert slam.world is before
    result = recording.feed(slam, 4)
    assert result.status == "tracked" and recording.error(result, 4) < 0.004
    assert set(result.landmark_of.values()) <= set(before.ids)


def test_the_motion_is_extrapolated_over_missing_frames(mapped, recording):
    slam, _ = mapped
    for number in (1, 2, 6):
        result = recording.feed(slam, number)
    assert result.status == "tracked" and recording.error(result, 6) < 0.003


def test_a_landmark_without_masks_is_retired(mapped, recording):
    slam, first = mapped
    slam._schedule = DetectionSchedule(EVERY_FRAME)
    lifecycle = replace(slam.config.lifecycle, visibility_interval=1, max_misses=2)
    slam.config = slam.mapper.config = replace(slam.config, lifecycle=lifecycle)
    removed = first.landmark_of[1]
    kept, recording.detections = recording.detections, [found[1:] for found in recording.detections]
    results = [recording.feed(slam, number) for number in range(1, 6)]
    recording.detections = kept
    assert removed in [id for result in results for id in result.retired]
    assert removed not in slam.world.ids and len(slam.world.ids) == 4


def test_an_object_moved_far_has_no_duplicate(cylinders, scenes):
    moved = replace(cylinders, places=(*cylinders.places[:-1], (-0.16, -0.02, 0.033)))
    before, after = Recording(cylinders, scenes, count=2), Recording(moved, scenes, count=16, step=1.2)
    slam = before.slam(cylinders.decoder)
    before.feed(slam, 0), before.feed(slam, 1)
    slam.detect = lambda frame, plane: after.detections[after.at]
    results = [after.feed(slam, number) for number in range(2, 16)]
    assert all(result.status == "tracked" for result in results)
    assert max(after.error(result, n) for n, result in enumerate(results, start=2)) < 0.004
    places = np.array([x.state.pose.translation[:2] for x in slam.world.landmarks.values()])
    assert len(places) == 5
    for x, y, _ in moved.places:
        assert np.linalg.norm(places - (x, y), axis=1).min() < 0.006


def test_an_object_moved_within_its_bounding_sphere_is_refitted(cylinders, scenes):
    """Its masks are still associated with it: the same landmark, without its older views."""
    pushed = replace(cylinders, places=(*cylinders.places[:-1], (-0.135, -0.16, 0.033)))
    before, after = Recording(cylinders, scenes, count=2), Recording(pushed, scenes, count=16)
    lifecycle = LandmarkLifecycleConfig(retry_interval=4)
    slam = before.slam(cylinders.decoder, SlamConfig(fit=FAST_FIT, lifecycle=lifecycle))
    first = before.feed(slam, 0)
    before.feed(slam, 1)
    slam.detect = lambda frame, plane: after.detections[after.at]
    results = [after.feed(slam, number) for number in range(2, 12)]
    assert all(result.status == "tracked" for result in results)
    assert max(after.error(result, n) for n, result in enumerate(results, start=2)) < 0.004
    assert slam.world.ids == tuple(sorted(first.new))
    places = {id: x.state.pose.translation[:2] for id, x in slam.world.landmarks.items()}
    (id,) = (k for k, place in places.items() if np.linalg.norm(place - pushed.places[-1][:2]) < 0.006)
    assert all(id not in key.landmark_ids for key in slam.keyframes if key.number < 2)
    for x, y, _ in cylinders.places[:-1]:
        assert min(np.linalg.norm(place - (x, y)) for place in places.values()) < 0.004


def test_landmarks_initialised_from_a_weak_pose_inherit_its_covariance(recording, cylinders):
    check = PoseCheckConfig(weak_position_std=0.0)
    slam = recording.slam(cylinders.decoder, SlamConfig(fit=FAST_FIT, pose_check=check))
    first = recording.feed(slam, 0)
    slam.mapper.world, slam.mapper.unmatched = slam.mapper.world.without(set(first.new[:1])), {}
    results = [recording.feed(slam, number) for number in (1, 2, 3)]
    assert {result.status for result in results} == {"weak"}
    (new,) = (id for result in results for id in result.new)
    new, old = slam.world.landmarks[new], slam.world.landmarks[first.new[1]]
    assert np.trace(new.covariance[3:, 3:]) > np.trace(old.covariance[3:, 3:])


def test_a_pose_that_depends_on_one_object_is_lost_in_time(cylinders, scenes):
    """One cylinder does not determine the rotation about its axis, so the uncertainty grows to the limit."""
    recording = Recording(cylinders, scenes, count=20)
    slam = recording.slam(cylinders.decoder, SlamConfig(fit=FAST_FIT, detection=EVERY_FRAME))
    assert [recording.feed(slam, number).status for number in range(4)] == 4 * ["tracked"]
    kept, recording.detections = recording.detections, [found[:1] for found in recording.detections]
    results = [recording.feed(slam, number) for number in range(4, 18)]
    map_while_lost, status = slam.world, [result.status for result in results]
    assert status[0] != "lost" and status[-1] == "lost"
    assert results[-1].position_std > results[0].position_std
    for number, result in enumerate(results, start=4):
        assert result.status == "lost" or recording.error(result, number) < 0.02
    recording.detections = kept
    back = recording.feed(slam, 18)
    assert back.status == "tracked" and recording.error(back, 18) < 0.004
    assert slam.world.ids == map_while_lost.ids


def test_relocalisation_leaves_map_and_camera_unchanged(mapped, recording):
    slam, _ = mapped
    world = slam.world
    recording.at = 5
    found = slam.relocalise(without_pose(recording.frames[5]))
    assert found is not None
    assert np.linalg.norm(found.tracked.T_world_camera[:3, 3] - recording.truth[5][:3, 3]) < 0.005
    assert slam.world is world
    result = recording.feed(slam, 1)
    assert result.number == 1 and result.status == "tracked"


def test_without_bundle_adjustment_landmarks_stay_as_initialised(recording, cylinders):
    config = SlamConfig(fit=FAST_FIT, use_bundle_adjustment=False)
    slam = recording.slam(cylinders.decoder, config)
    assert "joint" not in recording.feed(slam, 0).seconds
    assert {landmark.n_updates for landmark in slam.world.landmarks.values()} == {1}


def test_seconds_are_those_of_the_clock(recording, cylinders):
    ticks = iter(range(1000))
    slam = recording.slam(cylinders.decoder)
    slam._timer = StageTimer(lambda: float(next(ticks)))
    first, second = recording.feed(slam, 0), recording.feed(slam, 1)
    assert first.seconds == {"detect": 1.0, "initialise": 2.0, "joint": 1.0}
    assert second.seconds == {"track": 1.0}


def test_before_the_first_frame_there_is_no_map(recording, cylinders):
    slam = recording.slam(cylinders.decoder)
    assert slam.world is None and slam.keyframes == [] and slam.object_estimates() == []


def test_frames_between_detections_are_tracked_as_accurately(recording, cylinders):
    slam = recording.slam(cylinders.decoder)
    results = [recording.feed(slam, number) for number in range(8)]
    assert [result.is_detected for result in results] == [True] + 7 * [False]
    assert all(len(result.landmark_of) == 5 and not result.is_keyframe for result in results[1:])
    assert max(recording.error(result, number) for number, result in enumerate(results)) < 0.003
    assert {landmark.n_hits for landmark in slam.world.landmarks.values()} == {1}


def test_detections_are_due_at_the_interval(recording, cylinders):
    config = SlamConfig(fit=FAST_FIT, detection=DetectionScheduleConfig(max_interval=3))
    slam = recording.slam(cylinders.decoder, config)
    detected = [recording.feed(slam, number).is_detected for number in range(7)]
    assert detected == [True, False, False, True, False, False, True]


def test_an_object_that_appears_is_detected_and_mapped_at_once(cylinders, scenes):
    fewer = replace(cylinders, places=cylinders.places[:-1])
    before, after = Recording(fewer, scenes, count=3), Recording(cylinders, scenes, count=6)
    slam = before.slam(cylinders.decoder)
    assert [before.feed(slam, number).is_detected for number in range(3)] == [True, False, False]
    slam.detect = lambda frame, plane: after.detections[after.at]
    results = [after.feed(slam, number) for number in range(3, 6)]
    assert results[0].is_detected and results[1].is_detected and not results[0].new
    assert len(results[1].new) == 1 and results[1].is_keyframe and len(slam.world.ids) == 5


def test_the_thread_of_the_joint_optimisation_does_not_change_the_result(cylinders, scenes):
    recording = Recording(cylinders, scenes, count=8, step=3.0)
    ends = []
    for concurrent in (True, False):
        config = SlamConfig(fit=FAST_FIT, concurrent=concurrent, joint_delay=2)
        slam = recording.slam(cylinders.decoder, config)
        results = [recording.feed(slam, number) for number in range(8)]
        slam.finish()
        ends.append(([result.T_world_camera for result in results], slam.world.landmarks))
    assert sum(result.is_keyframe for result in results) > 1
    (poses, landmarks), (others, other_landmarks) = ends
    np.testing.assert_array_equal(poses, others)
    for id, landmark in landmarks.items():
        np.testing.assert_array_equal(landmark.state.code, other_landmarks[id].state.code)
        assert landmark.n_updates == other_landmarks[id].n_updates > 1
