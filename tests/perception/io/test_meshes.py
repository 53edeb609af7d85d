"""Mesh files: all formats, announcements beyond the file, references to other files, random damage."""

import io
import json
import os
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from perception.errors import InvalidInputError
from perception.io import meshes
from perception.io.meshes import read_mesh, read_mesh_scene
from tests.fuzzing import SHORT, damaged_bytes, damaged_json

BOX = trimesh.creation.box((0.1, 0.2, 0.3))
PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nelement face {}\nend_header\n"


def exported(kind):
    content = BOX.export(file_type=kind)
    return content.encode() if isinstance(content, str) else content


def glb_tree(content):
    length = struct.unpack("<I", content[12:16])[0]
    return json.loads(content[20 : 20 + length]), content[20 + length :]


def glb_bytes(tree, rest=b""):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    return header + struct.pack("<I4s", len(text), b"JSON") + text + rest


def refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidInputError, match=message) as caught:
        read_mesh(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
def test_every_format_gives_the_same_surface(tmp_path, kind):
    (tmp_path / f"a.{kind}").write_bytes(exported(kind))
    mesh = read_mesh(tmp_path / f"a.{kind}")
    assert mesh.area == pytest.approx(BOX.area, rel=1e-5)
    np.testing.assert_allclose(mesh.extents, (0.1, 0.2, 0.3), atol=1e-6)


def test_a_scene_keeps_its_nodes(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(BOX, node_name="arm/part")
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    assert "arm/part" in read_mesh_scene(tmp_path / "a.glb").graph.nodes_geometry


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", PLY.format("ascii", 1, 10**9).encode() + b"0\n", "more elements 'face' than it has bytes"),
        ("a.ply", PLY.format("ascii", "9" * 5000, 1).encode(), "more elements 'vertex' than it has bytes"),
        ("a.ply", b"ply\n" + b"comment\n" * 20_000, "has no PLY header"),
        ("a.glb", b"glTF", "has no GLB header"),
        ("a.glb", b"glTF\2\0\0\0\xff\xff\xff\x7f" + bytes(100), "JSON chunk is missing"),
        ("a.stl", bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(50), "export it again"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99\n", "export it again"),
        ("a.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite; export it again"),
        ("a.txt", b"", "none of .ply, .obj, .glb, .stl; convert it"),
    ],
)
def test_damage_is_named_with_its_remedy(tmp_path, name, content, message):
    refused(tmp_path, name, content, message)


GLB_FAULTS = {
    "more data than it holds": lambda t: t["accessors"][0].update(count=4_000_000_000),
    "refers to another file": lambda t: t["buffers"][0].update(uri="../../etc/passwd"),
    "no tree": lambda t: t["nodes"].extend([{"children": [99]}, {"children": [99]}]),
    "export it without compression": lambda t: t.update(extensionsRequired=["KHR_draco_mesh_compression"]),
    "an accessor has no count": lambda t: t["accessors"][0].pop("count"),
    "nodes are no list": lambda t: t.update(nodes=3),
}


@pytest.mark.parametrize("message", GLB_FAULTS)
def test_faults_of_a_glb_tree_are_named(tmp_path, message):
    tree, rest = glb_tree(exported("glb"))
    GLB_FAULTS[message](tree)
    refused(tmp_path, "a.glb", glb_bytes(tree, rest), message)


def test_one_mesh_used_by_many_nodes_is_bounded(tmp_path, monkeypatch):
    tree, rest = glb_tree(exported("glb"))
    tree["nodes"] += [{"mesh": 0}] * 1000
    monkeypatch.setattr(meshes, "MAX_TRIANGLES", 1000)
    refused(tmp_path, "a.glb", glb_bytes(tree, rest), "its nodes have more than 3000 vertices")


def test_large_meshes_and_pipes_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "MAX_TRIANGLES", 11)
    refused(tmp_path, "a.stl", exported("stl"), "has 12 triangles, at most 11 are read; simplify it")
    monkeypatch.setattr(meshes, "MAX_MESH_BYTES", 100)
    refused(tmp_path, "a.stl", exported("stl"), "is too large")
    os.mkfifo(tmp_path / "b.stl")
    with pytest.raises(InvalidInputError, match="is a named pipe"):
        read_mesh(tmp_path / "b.stl")
    with pytest.raises(InvalidInputError, match=r"c\.stl is missing"):
        read_mesh(tmp_path / "c.stl")


def test_no_other_file_is_read(tmp_path):
    os.mkfifo(tmp_path / "a.mtl")  # reading it would block
    (tmp_path / "a.obj").write_bytes(b"mtllib a.mtl\nusemtl x\n" + exported("obj"))
    assert read_mesh(tmp_path / "a.obj").area == pytest.approx(BOX.area)


def reads_or_refuses(path, content):
    path.write_bytes(content)
    try:
        mesh = read_mesh(path)
    except InvalidInputError as error:
        assert path.name in str(error)
    else:
        assert len(mesh.faces) and np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
@SHORT
@given(data=st.data())
def test_random_damage_is_read_or_refused(tmp_path, kind, data):
    reads_or_refuses(tmp_path / f"a.{kind}", data.draw(damaged_bytes(exported(kind))))


@SHORT
@given(data=st.data())
def test_any_glb_tree_is_read_or_refused(tmp_path, data):
    tree, rest = glb_tree(exported("glb"))
    reads_or_refuses(tmp_path / "a.glb", glb_bytes(data.draw(damaged_json(tree)), rest))


def test_ascii_ply_is_read(tmp_path):
    content = BOX.export(file_type="ply", encoding="ascii")
    (tmp_path / "a.ply").write_bytes(content)
    assert len(trimesh.load(io.BytesIO(content), file_type="ply").faces) == len(
        read_mesh(tmp_path / "a.ply").faces
    )


@pytest.mark.filterwarnings("error")
def test_numbers_beyond_single_precision_are_refused_without_a_warning(tmp_path):
    content = BOX.export(file_type="ply", encoding="ascii").decode()
    header, _, body = content.partition("end_header\n")
    (tmp_path / "a.ply").write_text(f"{header}end_header\n1e39{body[body.index(' ') :]}")
    with pytest.raises(InvalidInputError, match=r"a\.ply has vertices that are not finite"):
        read_mesh(tmp_path / "a.ply")
