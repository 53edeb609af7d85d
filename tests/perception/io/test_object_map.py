import json
import os

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from perception.errors import InvalidInputError
from perception.io.object_map import read_object_map, read_ply, write_object_map
from perception.types import ObjectEstimate, TriangleMesh
from tests.fuzzing import SHORT, damaged_json


def estimate(id=3, category="can", **changes):
    box = trimesh.creation.box((0.06, 0.06, 0.12))
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = (0.4, -0.2, 0.06)
    fields = {
        "id": id,
        "category": category,
        "code": np.linspace(-1, 1, 16),
        "T_world_object": T,
        "scale": np.full(3, 0.066),
        "mesh": TriangleMesh(box.vertices, box.faces),
        "score": 0.8,
        "n_views": 5,
        "residual": 0.002,
    }
    return ObjectEstimate(**(fields | changes))


def test_round_trip(tmp_path):
    above = estimate(4, "mug", status="implausible", resting="upside-down", rests_on=3)
    write_object_map(tmp_path, [estimate(), above])
    first, second = read_object_map(tmp_path)
    sent = estimate()
    np.testing.assert_allclose(first.mesh.vertices, sent.mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(first.mesh.faces, sent.mesh.faces)
    np.testing.assert_allclose(first.T_world_object, sent.T_world_object)
    np.testing.assert_allclose(first.code, sent.code)
    assert (first.id, first.category, first.score, first.n_views, first.residual) == (3, "can", 0.8, 5, 0.002)
    assert (first.resting, first.rests_on) == ("upright", None)
    assert (second.category, second.status) == ("mug", "implausible")
    assert (second.resting, second.rests_on) == ("upside-down", 3)


def test_files_are_as_others_expect_them(tmp_path):
    write_object_map(tmp_path, [estimate()])
    entry = json.loads((tmp_path / "objects.json").read_text())[0]
    assert entry["height"] == pytest.approx(0.12) and entry["radius"] == pytest.approx(0.03)
    assert (entry["resting"], entry["rests_on"]) == ("upright", "plane")
    assert len(entry["code"]) == 16 and np.shape(entry["T_world_object"]) == (4, 4)
    mesh = trimesh.load(tmp_path / "objects/3_can.ply")
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.06 * 0.06 * 0.12, rel=1e-5)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), (0.4, -0.2, 0.06), atol=1e-7)  # world frame


def test_a_smaller_map_leaves_no_old_meshes(tmp_path):
    write_object_map(tmp_path, [estimate(1), estimate(2)])
    write_object_map(tmp_path, [estimate(2)])
    assert [path.name for path in (tmp_path / "objects").iterdir()] == ["2_can.ply"]


def test_what_is_not_finite_costs_that_object_alone(tmp_path, caplog):
    bad = [
        estimate(1, residual=float("inf")),
        estimate(2, scale=np.array([0.05, np.nan, 0.05])),
        estimate(3, mesh=TriangleMesh(np.full((3, 3), np.nan), np.arange(3)[None])),
        estimate(4, mesh=TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))),
    ]
    rejected = write_object_map(tmp_path, [*bad, estimate(5)])
    assert [item.id for item in rejected] == [1, 2, 3, 4]
    assert [entry["id"] for entry in json.loads((tmp_path / "objects.json").read_text())] == [5]
    assert [path.name for path in (tmp_path / "objects").iterdir()] == ["5_can.ply"]
    assert caplog.text.count("is left out of the object map") == 4


BAD_ENTRIES = {
    "scale": (lambda e: e.update(scale=[0, 1, 1]), "scale must be 0.001 to 10 m"),
    "code": (lambda e: e.update(code=[1, 2]), "code must be 16 finite numbers"),
    "missing": (lambda e: e.pop("T_world_object"), "T_world_object must be 16 finite numbers"),
    "pose": (lambda e: e.update(T_world_object=np.diag([2, 2, 2, 1]).tolist()), "rigid"),
    "path": (lambda e: e.update(category="../../can"), "is no class name"),
    "class": (lambda e: e.update(category="spoon"), "spoon.ply is missing"),
    "id": (lambda e: e.update(id="one"), "are no number and name"),
    "text as score": (lambda e: e.update(score="nan"), "score must be a finite number"),
    "negative views": (lambda e: e.update(n_views=-5), "n_views -5 is no number of images"),
    "ragged pose": (lambda e: e.update(T_world_object=[[1], [0, 1]]), "must be 16 finite numbers"),
    "negative id": (lambda e: e.update(id=-1), "are no number and name"),
    "truth as id": (lambda e: e.update(id=True), "are no number and name"),
}


@pytest.mark.parametrize("damage, message", BAD_ENTRIES.values(), ids=BAD_ENTRIES)
def test_bad_entries_are_named(tmp_path, damage, message):
    write_object_map(tmp_path, [estimate()])
    entries = json.loads((tmp_path / "objects.json").read_text())
    damage(entries[0])
    (tmp_path / "objects.json").write_text(json.dumps(entries))
    with pytest.raises(InvalidInputError, match=message) as caught:
        read_object_map(tmp_path)
    assert "objects.json, object 0" in str(caught.value)


def test_an_entry_that_is_no_object_is_named(tmp_path):
    (tmp_path / "objects.json").write_text("[7]")
    with pytest.raises(InvalidInputError, match="object 0: it is no JSON object"):
        read_object_map(tmp_path)


def test_an_id_is_used_once(tmp_path):
    write_object_map(tmp_path, [estimate()])
    entries = json.loads((tmp_path / "objects.json").read_text())
    (tmp_path / "objects.json").write_text(json.dumps(2 * entries))
    with pytest.raises(InvalidInputError, match="object 1: another object has the id"):
        read_object_map(tmp_path)


def test_broken_mesh_is_named(tmp_path):
    write_object_map(tmp_path, [estimate()])
    path = tmp_path / "objects/3_can.ply"
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(InvalidInputError, match=r"3_can\.ply"):
        read_object_map(tmp_path)


def test_a_pipe_in_place_of_a_mesh_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.ply")
    with pytest.raises(InvalidInputError, match=r"a\.ply is a named pipe, not a regular file"):
        read_ply(tmp_path / "a.ply")


def test_absurd_coordinates_are_refused_before_they_overflow(tmp_path):
    write_object_map(tmp_path, [estimate()])
    entries = json.loads((tmp_path / "objects.json").read_text())
    entries[0]["T_world_object"][0][3] = 201.0
    (tmp_path / "objects.json").write_text(json.dumps(entries))
    with pytest.raises(InvalidInputError, match=r"object 0: its pose and mesh must be within 200 m"):
        read_object_map(tmp_path)


@SHORT
@given(data=st.data())
def test_any_change_is_read_or_refused(tmp_path, data):
    write_object_map(tmp_path, [estimate(), estimate(4, "mug")])
    path = tmp_path / "objects.json"
    path.write_text(json.dumps(data.draw(damaged_json(json.loads(path.read_text())))))
    try:
        objects = read_object_map(tmp_path)
    except InvalidInputError as error:
        assert str(path) in str(error)
        return
    for found in objects:
        assert np.isfinite(found.mesh.vertices).all() and np.isfinite(found.T_world_object).all()


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("rests_on", "table", "rests_on 'table' is neither"),
        ("resting", "leaning", "resting 'leaning' is none of"),
    ],
)
def test_unknown_resting_poses_are_refused(tmp_path, key, value, problem):
    write_object_map(tmp_path, [estimate()])
    entries = json.loads((tmp_path / "objects.json").read_text())
    entries[0][key] = value
    (tmp_path / "objects.json").write_text(json.dumps(entries))
    with pytest.raises(InvalidInputError, match=problem):
        read_object_map(tmp_path)


def test_maps_without_resting_poses_are_of_upright_objects(tmp_path):
    write_object_map(tmp_path, [estimate()])
    entries = json.loads((tmp_path / "objects.json").read_text())
    del entries[0]["resting"], entries[0]["rests_on"]
    (tmp_path / "objects.json").write_text(json.dumps(entries))
    (read,) = read_object_map(tmp_path)
    assert (read.resting, read.rests_on) == ("upright", None)


@pytest.mark.parametrize(
    ("below", "problem"),
    [
        ({3: 9}, "can_3 rests on object 9, which is not in the map"),
        ({3: 3}, "rests on itself"),
        ({3: 4, 4: 3}, "itself"),
    ],
)
def test_stacks_end_on_the_plane(tmp_path, below, problem):
    write_object_map(tmp_path, [estimate(), estimate(4, "mug")])
    entries = json.loads((tmp_path / "objects.json").read_text())
    for entry in entries:
        entry["rests_on"] = below.get(entry["id"], "plane")
    (tmp_path / "objects.json").write_text(json.dumps(entries))
    with pytest.raises(InvalidInputError, match=problem):
        read_object_map(tmp_path)


def test_what_rests_on_an_object_that_is_left_out_can_be_read(tmp_path):
    flat = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    write_object_map(tmp_path, [estimate(mesh=flat), estimate(4, "mug", rests_on=3)])
    (upper,) = read_object_map(tmp_path)
    assert (upper.id, upper.rests_on) == (4, None)


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("score", 1.5, "score in 0..1"),
        ("score", -0.1, "score in 0..1"),
        ("n_views", 2.5, "n_views 2.5 is no number of images"),
        ("n_views", -1, "n_views -1"),
        ("status", "fine", "status 'fine' is none of converged"),
        ("status", ["converged"], "is none of"),
        ("height", 0.2, "height 0.2 m is not that of 3_can.ply, 0.12 m"),
        ("radius", 0.02, "radius 0.02 m is not that of"),
    ],
)
def test_entries_agree_with_each_other_and_the_mesh(tmp_path, key, value, problem):
    write_object_map(tmp_path, [estimate()])
    entries = json.loads((tmp_path / "objects.json").read_text())
    entries[0][key] = value
    (tmp_path / "objects.json").write_text(json.dumps(entries))
    with pytest.raises(InvalidInputError, match=problem):
        read_object_map(tmp_path)


def test_a_mesh_far_from_its_pose_is_refused(tmp_path):
    write_object_map(tmp_path, [estimate()])
    entries = json.loads((tmp_path / "objects.json").read_text())
    entries[0]["T_world_object"][0][3] += 1.0
    (tmp_path / "objects.json").write_text(json.dumps(entries))
    with pytest.raises(InvalidInputError, match=r"object 0: 3_can\.ply is far from its pose"):
        read_object_map(tmp_path)
