import numpy as np
import pytest

from app.runs.replay import Recorder
from app.viewer.timeline import Story, matrix


def moments(recording, kind, **data):
    """Moments just after notes of a kind."""
    story = Story(recording)
    for note in recording.notes:
        if note.kind == kind and all(note.data.get(key) == value for key, value in data.items()):
            yield story.at(note.time + 1e-6)


def test_objects_appear_with_their_first_fit_and_improve(recording):
    before = next(moments(recording, "stage", name="reconstruct"))
    assert not before.objects and before.n_frames == before.n_found == 2
    fits = list(moments(recording, "fit"))
    assert [moment.objects[0].iteration for moment in fits] == [0, 8, 30]
    done = next(moments(recording, "objects"))
    assert done.objects[0].status == "reconstructed" and done.objects[0].iteration is None


def test_a_carried_object_moves_with_the_hand_and_stays_where_it_is_put(recording):
    start = next(moments(recording, "plan")).objects[0].T_world_object
    story = Story(recording)
    transfer = next(n.time for n in recording.notes if n.data.get("phase") == "transfer")
    place = next(n.time for n in recording.notes if n.data.get("phase") == "place")
    halfway = story.at((transfer + place) / 2)
    tcp = matrix(halfway.poses[1])
    carried = halfway.objects[0].T_world_object
    assert halfway.objects[0].status == "in the hand"
    assert carried[1, 3] == pytest.approx(tcp[1, 3]) and start[1, 3] < carried[1, 3] < 0.2
    end = story.at(recording.now)
    assert end.objects[0].status == "put down" and not end.placements
    np.testing.assert_allclose(end.objects[0].T_world_object[:3, 3], (0.4, 0.2, 0.05), atol=1e-9)


def test_goals_path_and_grasps_show_while_they_matter(recording):
    plan = next(moments(recording, "plan"))
    np.testing.assert_allclose(plan.placements["can_0"][:3, 3], (0.4, 0.2, 0.05), atol=1e-9)
    approach = next(moments(recording, "action", phase="approach"))
    assert approach.grasps is not None and approach.grasps.shape == (3, 4, 4)
    np.testing.assert_allclose(approach.grasps[0][:3, 3], (0.4, -0.2, 0.1), atol=1e-9)
    assert approach.path is not None and len(approach.path) == 3
    after = next(moments(recording, "action", phase="placed"))
    assert after.path is None and after.grasps is None


def test_going_back_tells_the_same_as_going_on(recording):
    story, times = Story(recording), np.linspace(0, recording.now, 23)
    forwards = [story.at(time) for time in times]
    for time, moment in reversed(list(zip(times, forwards))):
        again = story.at(time)
        assert (again.caption, again.stage, again.n_frames) == (moment.caption, moment.stage, moment.n_frames)
        assert {k: v.status for k, v in again.objects.items()} == {
            k: v.status for k, v in moment.objects.items()
        }


def test_the_stages_and_residuals_are_those_recorded(recording):
    story = Story(recording)
    spans = {span.name: span for span in story.stages}
    assert list(spans) == ["scan", "detect", "reconstruct", "plan", "execute"]
    assert spans["scan"].seconds == 3.0 and spans["detect"].end is None
    assert story.residuals(0, recording.now) == ([8, 30], [0.004, 0.001])
    assert story.residuals(0, spans["reconstruct"].begin) == ([], [])


def test_a_camera_that_moves_by_itself_leaves_its_way_and_has_stages_of_its_own():
    recorder = Recorder(bodies=("camera",))
    for stage, xs in (("slam", (0, 1, 2)), ("lost", (2.5,)), ("slam", (3, 4))):
        recorder.note("stage", name=stage)
        for x in xs:
            recorder.sample(float(x), np.zeros(0), 0.0, np.array([[x, 0, 0, 1, 0, 0, 0.0]]))
        recorder.note("look", index=0)
    story = Story(recorder)
    assert story.stage_titles == {"slam": "Track and map", "lost": "Lost"}
    lost = story.at(next(n.time for n in recorder.notes if n.data.get("name") == "lost") + 1e-6)
    assert lost.stage == "lost" and lost.n_found == 1
    np.testing.assert_allclose(lost.path[:, 0], (0, 1, 2))
    end = story.at(recorder.now)
    np.testing.assert_allclose(end.path[:, 0], (0, 1, 2, 2.5, 3, 4))
    assert story.at(recorder.now).path is end.path  # not sent again
