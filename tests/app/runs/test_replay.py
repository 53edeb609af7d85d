import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.runs.replay import BEAT, Recorder, read_recording
from perception.errors import InvalidInputError
from tests.fuzzing import SHORT, damaged_bytes, damaged_json


def test_show_time_follows_the_robot_and_beats_for_thoughts():
    recorder = Recorder(bodies=("hand",))
    recorder.sample(5.0, np.zeros(7), 0.0)
    recorder.note("stage", name="scan")
    recorder.sample(6.0, np.zeros(7), 0.0)
    recorder.note("fit", id=0)
    assert recorder.show_times == [0.0, pytest.approx(BEAT["stage"] + 1.0)]
    assert recorder.now == pytest.approx(BEAT["stage"] + 1.0 + BEAT["fit"])
    assert recorder.simulated(0.1) == 5.0 and recorder.simulated(99) == 6.0


def test_a_recording_comes_back_as_it_was(tmp_path):
    recorder = Recorder(bodies=("hand", "tcp"))
    for step in range(3):
        recorder.sample(0.1 * step, np.full(7, step, dtype=np.float64), 0.04, np.full((2, 7), 0.25 * step))
    recorder.note("action", phase="grasp", name="mug_2", T=np.eye(4), message="", done=0, total=1)
    recorder.write(tmp_path)
    again = read_recording(tmp_path)
    assert again.bodies == recorder.bodies and again.now == pytest.approx(recorder.now)
    np.testing.assert_allclose(again.poses, recorder.poses)
    np.testing.assert_allclose(again.show_times, recorder.show_times)
    assert again.notes[0].kind == "action" and again.notes[0].data["T"] == np.eye(4).tolist()
    with np.load(tmp_path / "replay.npz") as arrays:  # no pickle needed
        assert arrays["joint_positions"].shape == (3, 7)
        assert list(arrays["event"]) == ["grasp mug 2"]
    Recorder().write(tmp_path / "empty")
    assert read_recording(tmp_path / "empty").now == 0.0


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("replay.npz", b"nothing", "no readable replay|not a readable replay"),
        ("replay.json", b'{"bodies": ["a"], "notes": []}', "do not belong together"),
        ("replay.json", b'{"bodies": ["hand"], "notes": [[0, "dance", {}]]}', "no note of kind 'dance'"),
        ("replay.json", b'{"bodies": ["hand"], "notes": [[1e12, "stage", {}]]}', "number from 0 to 14400 s"),
        ("replay.json", b'{"bodies": ["hand"], "notes": [[-1, "stage", {}]]}', "number from 0 to 14400 s"),
        ("replay.glb", b"glTF", "not a readable GLB"),
    ],
)
def test_a_damaged_recording_is_named(tmp_path, name, content, message):
    recorder = Recorder(bodies=("hand",))
    recorder.sample(0.0, np.zeros(7), 0.0)
    recorder.sample(0.1, np.zeros(7), 0.0, np.ones((1, 7)))
    recorder.write(tmp_path)
    bodies = json.loads((tmp_path / "replay.json").read_text())["bodies"]
    assert bodies == ["hand"]
    if name == "replay.json" and b'"a"' in content:
        content = b'{"bodies": ["a", "b"], "notes": []}'
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidInputError, match=message):
        read_recording(tmp_path)


@pytest.mark.parametrize("times", [(-1.0, 0.0), (0.0, 1e12)])
def test_samples_outside_four_hours_are_refused(tmp_path, times):
    recorder = Recorder()
    for time in times:
        recorder.sample(0.0, np.zeros(7), 0.0)
        recorder.show_times[-1] = time
    recorder.write(tmp_path)
    with pytest.raises(InvalidInputError, match="show_time must be from 0 to 14400 s"):
        read_recording(tmp_path)


def test_robot_times_ascend(tmp_path):
    recorder = Recorder(bodies=("tcp",))
    for time in (1.0, 2.0):
        recorder.sample(time, np.zeros(7), 0.04, np.array([[0.0, 0, 0, 1, 0, 0, 0]]))
    recorder.times[0] = 3.0
    recorder.write(tmp_path)
    with pytest.raises(InvalidInputError, match=r"\(time must be in ascending order\): run it again"):
        read_recording(tmp_path)


def test_bodies_without_a_sample_are_refused(tmp_path):
    Recorder(bodies=("hand",)).write(tmp_path)
    with pytest.raises(InvalidInputError, match="there is no sample of the bodies"):
        read_recording(tmp_path)


NOTES = {
    "stage": {"name": "scan"},
    "look": {"index": 0},
    "found": {"index": 0, "count": 1},
    "fit": {
        "id": 0, "category": "mug", "iteration": 1, "code": [0.0] * 16, "T_world_object": np.eye(4).tolist(),
        "scale": [0.1, 0.1, 0.1], "residual": 0.001,
    },
    "action": {"phase": "grasp", "name": "mug_0", "message": ""},
    "path": {"points": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]},
}  # fmt: skip


@pytest.fixture
def recorded(tmp_path):
    recorder = Recorder(bodies=("hand",))
    for step in range(3):
        recorder.sample(0.1 * step, np.zeros(7), 0.04, np.ones((1, 7)))
    for kind, data in NOTES.items():
        recorder.note(kind, **data)
    recorder.write(tmp_path)
    return tmp_path


def is_read_or_refused(folder):
    try:
        again = read_recording(folder)
    except InvalidInputError as error:
        assert str(folder) in str(error)
    else:
        assert np.isfinite(again.show_times).all() and all(np.isfinite(p).all() for p in again.poses)


@SHORT
@given(data=st.data())
def test_any_change_of_the_notes_is_read_or_refused(recorded, data):
    path = recorded / "replay.json"
    original = path.read_text()
    path.write_text(json.dumps(data.draw(damaged_json(json.loads(original)))))
    is_read_or_refused(recorded)
    path.write_text(original)


@pytest.mark.parametrize("name", ["replay.json", "replay.npz"])
@SHORT
@given(data=st.data())
def test_random_damage_is_read_or_refused(recorded, name, data):
    original = (recorded / name).read_bytes()
    (recorded / name).write_bytes(data.draw(damaged_bytes(original)))
    is_read_or_refused(recorded)
    (recorded / name).write_bytes(original)
