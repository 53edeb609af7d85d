"""Snapshots at any show time, forwards and backwards."""

import numpy as np
import pytest

from app.runs.replay import Recorder
from app.viewer.snapshot import TASK_STAGES, pose_matrix
from app.viewer.timeline import MAX_PATH_POINTS, Timeline


def snapshots(recording, kind, **data):
    """Snapshots just after the notes of a kind."""
    timeline = Timeline(recording)
    for note in recording.notes:
        if note.kind == kind and all(note.data.get(key) == value for key, value in data.items()):
            yield timeline.at(note.time + 1e-6)


def moving_body(name, xs):
    """A recording of one body that moves along x, with a sample per second."""
    recorder = Recorder(bodies=(name,))
    for x in xs:
        recorder.sample(float(x), np.zeros(0), 0.0, np.array([[x, 0, 0, 1, 0, 0, 0.0]]))
    return recorder


def test_objects_appear_with_their_first_fit_and_improve(recording):
    before = next(snapshots(recording, "stage", name="reconstruct"))
    assert not before.objects and before.n_frames == before.n_searched == 2
    fits = list(snapshots(recording, "fit"))
    assert [snapshot.objects[0].iteration for snapshot in fits] == [0, 8, 30]
    done = next(snapshots(recording, "objects"))
    assert done.objects[0].status == "reconstructed" and done.objects[0].iteration is None


def test_a_carried_object_moves_with_the_gripper_and_stays_at_its_release_pose(recording):
    start = next(snapshots(recording, "plan")).objects[0].T_world_object
    timeline = Timeline(recording)
    transfer = next(n.time for n in recording.notes if n.data.get("phase") == "transfer")
    place = next(n.time for n in recording.notes if n.data.get("phase") == "place")
    halfway = timeline.at((transfer + place) / 2)
    tcp = pose_matrix(halfway.poses[1])
    carried = halfway.objects[0].T_world_object
    assert halfway.objects[0].status == "held"
    assert carried[1, 3] == pytest.approx(tcp[1, 3]) and start[1, 3] < carried[1, 3] < 0.2
    end = timeline.at(recording.now)
    assert end.objects[0].status == "placed" and not end.goals
    np.testing.assert_allclose(end.objects[0].T_world_object[:3, 3], (0.4, 0.2, 0.05), atol=1e-9)


def test_goals_path_and_grasps_are_part_of_their_phases(recording):
    plan = next(snapshots(recording, "plan"))
    np.testing.assert_allclose(plan.goals["can_0"][:3, 3], (0.4, 0.2, 0.05), atol=1e-9)
    approach = next(snapshots(recording, "action", phase="approach"))
    assert approach.grasps is not None and approach.grasps.shape == (3, 4, 4)
    np.testing.assert_allclose(approach.grasps[0][:3, 3], (0.4, -0.2, 0.1), atol=1e-9)
    assert approach.path is not None and len(approach.path) == 3
    after = next(snapshots(recording, "action", phase="placed"))
    assert after.path is None and after.grasps is None


def test_seeking_backwards_restores_the_same_snapshots(recording):
    timeline, times = Timeline(recording), np.linspace(0, recording.now, 23)
    forwards = [timeline.at(time) for time in times]
    for time, expected in reversed(list(zip(times, forwards, strict=True))):
        again = timeline.at(time)
        for name in ("time", "stage", "caption", "n_frames", "n_searched"):
            assert getattr(again, name) == getattr(expected, name)
        assert again.objects.keys() == expected.objects.keys() and again.goals.keys() == expected.goals.keys()
        for id, state in again.objects.items():
            assert (state.status, state.iteration) == (
                expected.objects[id].status,
                expected.objects[id].iteration,
            )
            np.testing.assert_array_equal(state.T_world_object, expected.objects[id].T_world_object)


def test_poses_are_those_of_the_latest_sample():
    timeline = Timeline(moving_body("hand", (0, 1, 2)))
    assert [timeline.at(time).poses[0, 0] for time in (-1.0, 0.0, 0.9, 1.0, 1.1, 2.0, 9.0)] == [
        0, 0, 0, 1, 1, 2, 2,
    ]  # fmt: skip
    assert timeline.end == 2.0
    assert Timeline(Recorder()).at(0.0).poses.shape == (0, 7)


def test_a_note_takes_effect_at_its_time():
    recorder = Recorder()
    recorder.note("stage", name="scan")
    recorder.note("stage", name="detect")
    timeline, begin = Timeline(recorder), recorder.notes[1].time
    assert timeline.at(begin - 1e-9).stage == "scan" and timeline.at(begin).stage == "detect"


def test_stages_and_residuals_are_those_recorded(recording):
    timeline = Timeline(recording)
    spans = {span.name: span for span in timeline.stages}
    assert list(spans) == ["scan", "detect", "reconstruct", "plan", "execute"]
    assert spans["scan"].seconds == 3.0 and spans["detect"].end is None
    done = next(note.time for note in recording.notes if note.kind == "done")
    assert (spans["scan"].begin, spans["scan"].end) == (0.0, done)
    assert timeline.residuals(0, recording.now) == ([8, 30], [0.004, 0.001])
    first = [note.time for note in recording.notes if note.kind == "fit"][1]
    assert timeline.residuals(0, first) == ([8], [0.004])
    assert (
        timeline.residuals(1, recording.now) == timeline.residuals(0, spans["reconstruct"].begin) == ([], [])
    )


def test_a_task_has_titles_of_its_future_stages_and_slam_of_the_recorded_ones():
    task = moving_body("tcp", (0,))
    task.note("stage", name="scan")
    assert Timeline(task).stage_titles == TASK_STAGES == Timeline(Recorder()).stage_titles
    slam = moving_body("camera", (0,))
    slam.note("stage", name="lost")
    slam.note("stage", name="slam")
    assert Timeline(slam).stage_titles == {"lost": "Tracking lost", "slam": "Tracking and mapping"}


def test_a_slam_run_shows_the_path_of_the_camera_so_far():
    recorder = Recorder(bodies=("camera",))
    for stage, xs in (("slam", (0, 1, 2)), ("lost", (2.5,)), ("slam", (3, 4))):
        recorder.note("stage", name=stage)
        for x in xs:
            recorder.sample(float(x), np.zeros(0), 0.0, np.array([[x, 0, 0, 1, 0, 0, 0.0]]))
        recorder.note("look", index=0)
    timeline = Timeline(recorder)
    lost = timeline.at(next(n.time for n in recorder.notes if n.data.get("name") == "lost") + 1e-6)
    assert lost.stage == "lost" and lost.n_searched == 1
    np.testing.assert_allclose(lost.path[:, 0], (0, 1, 2))
    end = timeline.at(recorder.now)
    np.testing.assert_allclose(end.path[:, 0], (0, 1, 2, 2.5, 3, 4))
    assert timeline.at(recorder.now).path is end.path  # an unchanged path is not sent again


def test_long_camera_paths_are_subsampled_and_arms_have_none():
    xs = np.arange(10 * MAX_PATH_POINTS)
    path = Timeline(moving_body("camera", xs)).at(float(xs[-1])).path
    np.testing.assert_array_equal(path[:, 0], xs[::10])
    assert Timeline(moving_body("tcp", (0, 1, 2))).at(2.0).path is None
    assert Timeline(moving_body("camera", (0, 1, 2))).at(0.5).path is None  # one point is no path
