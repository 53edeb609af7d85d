"""Users' meshes: frames, inside tests, cached decomposition, and one clear line for every bad file."""

import logging

import numpy as np
import pytest
import trimesh

from sim_assets.errors import ObjectFileError
from sim_assets.objects import load_user_object, load_user_objects, occupancy_grid, sample_object
from sim_assets.objects.mesh_shape import MeshShape


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def write(tmp_path, category, name, mesh):
    path = tmp_path / "meshes" / category / name
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)
    return path


def a_can(radius=0.03, height=0.1):
    return trimesh.creation.cylinder(radius, height, sections=32)


def test_meshes_of_all_formats_load_in_the_object_frame(tmp_path):
    for suffix in ("ply", "obj", "glb", "stl"):
        write(tmp_path, "can", f"tin.{suffix}", a_can().apply_translation((0.3, -0.2, 0.5)))
    models = load_user_objects(tmp_path / "meshes")
    assert [model.category for model in models] == ["can"] * 4
    for model in models:
        assert model.split == "user" and model.parameters is None
        np.testing.assert_allclose(model.mesh.bounds, [(-0.03, -0.03, 0), (0.03, 0.03, 0.1)], atol=1e-6)
        assert model.height == pytest.approx(0.1) and model.radius == pytest.approx(0.03)
        assert len(model.collision) == 1, "a convex mesh is one piece"


def test_mug_is_turned_until_its_handle_lies_along_x(tmp_path):
    mug = sample_object("mug", "test", np.random.default_rng(0))
    turned = mug.mesh.copy().apply_transform(trimesh.transformations.rotation_matrix(2.0, (0, 0, 1)))
    turned.apply_translation((0.01, 0.02, 0.03))
    from sim_assets.objects.user import _in_object_frame

    mesh = _in_object_frame(turned, "mug")
    np.testing.assert_allclose(mesh.bounds, mug.mesh.bounds, atol=2e-3)


def test_inside_test_of_a_mesh_agrees_with_the_family_that_made_it():
    mug = sample_object("mug", "test", np.random.default_rng(1))
    shape = MeshShape(mug.mesh, "mug")
    points = np.random.default_rng(0).uniform(*mug.mesh.bounds, (4000, 3))
    assert (shape.inside(points) == mug.inside(points)).mean() > 0.995
    surface = mug.mesh.sample(2000, seed=0)
    truth, estimate = mug.is_handle(surface), shape.is_handle(surface)
    assert (truth == estimate).mean() > 0.97 and estimate.sum() > 0.7 * truth.sum()


def test_grid_of_a_mesh_file_holds_its_volume(tmp_path):
    model = load_user_object(write(tmp_path, "can", "tin.ply", a_can()), "can")
    grid = occupancy_grid(model, resolution=16, supersample=2)
    assert grid.sum() * (2 * 0.1 / 1.8 / 16) ** 3 == pytest.approx(model.mesh.volume, rel=0.05)


def test_cavity_stays_free_and_the_second_load_comes_from_the_cache(tmp_path, caplog):
    outer, inner = (trimesh.creation.cylinder(r, 0.08, sections=32) for r in (0.04, 0.036))
    cup = trimesh.boolean.difference([outer, inner.apply_translation((0, 0, 0.005))], engine="manifold")
    path = write(tmp_path, "bowl", "cup.ply", cup)
    with caplog.at_level(logging.INFO):
        first = load_user_object(path, "bowl")
    assert "Decomposing cup.ply" in caplog.text
    hulls = [trimesh.convex.convex_hull(piece.vertices) for piece in first.collision]
    cavity = np.array([(0.0, 0.0, z) for z in (0.015, 0.04, 0.07)] + [(0.03, 0.0, 0.05), (0.0, -0.03, 0.03)])
    for hull in hulls:
        outside = ((cavity[:, None] - hull.triangles[:, 0]) * hull.face_normals).sum(axis=-1)
        assert (outside.max(axis=1) > 0).all()
    assert sum(hull.volume for hull in hulls) == pytest.approx(cup.volume, rel=0.25)
    assert sum(abs(hull.bounds[0, 2]) < 1e-6 for hull in hulls) == 1, "only the base touches the table"
    caplog.clear()
    with caplog.at_level(logging.INFO):
        second = load_user_object(path, "bowl")
    assert "Decomposing" not in caplog.text
    for a, b in zip(first.collision, second.collision, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_damaged_cache_is_made_again(tmp_path, caplog):
    path = write(tmp_path, "can", "tin.ply", a_can())
    load_user_object(path, "can")
    (stored,) = (tmp_path / "cache" / "nodeslam").glob("convex_*.npz")
    stored.write_bytes(b"garbage")
    with caplog.at_level(logging.WARNING):
        assert len(load_user_object(path, "can").collision) == 1
    assert "unreadable" in caplog.text


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.stl", b"solid nothing"), ("a.obj", b"garbage\n"), ("a.ply", b""), ("a.glb", b"\0\1")],
)
def test_corrupt_files_are_named(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ObjectFileError, match=rf"{name} .*export it again"):
        load_user_object(path, "can")


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (1000.0, "is 100 m long: looks like millimetres; scale it by 0.001"),
        (100.0, "is 10 m long: looks like centimetres; scale it by 0.01"),
        (0.05, "is 0.005 m long; objects of 0.02 to 0.5 m are possible"),
    ],
)
def test_absurd_sizes_say_what_they_look_like(tmp_path, scale, message):
    path = write(tmp_path, "can", "tin.ply", a_can().apply_scale(scale))
    with pytest.raises(ObjectFileError, match=message):
        load_user_object(path, "can")


def test_open_surfaces_are_refused(tmp_path):
    tin = a_can()
    tin.update_faces(np.arange(len(tin.faces)) % 3 != 0)
    path = write(tmp_path, "can", "tin.ply", tin)
    with pytest.raises(ObjectFileError, match=r"not watertight .* close its holes"):
        load_user_object(path, "can")


def test_folders_are_checked(tmp_path):
    with pytest.raises(ObjectFileError, match="is not a folder; expected DIR/<class>"):
        load_user_objects(tmp_path / "nowhere")
    with pytest.raises(ObjectFileError, match="holds no meshes"):
        load_user_objects(tmp_path)
    (tmp_path / "plate").mkdir()
    with pytest.raises(ObjectFileError, match="'plate' is none of the classes mug, bowl, bottle, can"):
        load_user_objects(tmp_path)
