"""Training shapes from a user's meshes: found, oriented, voxelised; what cannot be used is said."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from app.cli import run
from app.training.shape_meshes import MeshFile, find_meshes, load_shapes, mesh_grid
from perception.errors import InvalidInputError
from sim_assets.objects.families import make_solid, sample_parameters
from sim_assets.objects.grids import solid_grid

SEED = 5


def cylinder(radius: float, height: float) -> trimesh.Trimesh:
    """Upright, z up."""
    return trimesh.creation.cylinder(radius, height, sections=64)


def write_shapenet(root: Path, synset: str, name: str, mesh: trimesh.Trimesh) -> Path:
    """In ShapeNet's place and frame: y up, the diagonal 1."""
    path = root / synset / name / "models" / "model_normalized.obj"
    path.parent.mkdir(parents=True)
    turned = mesh.copy()
    turned.vertices = mesh.vertices[:, (0, 2, 1)] * (1, 1, -1) / np.linalg.norm(mesh.extents)
    turned.export(path)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three usable cans in ShapeNet's layout, two mugs by class name; a leak, damage, and a stranger."""
    root = tmp_path / "meshes"
    for index, height in enumerate((0.08, 0.12, 0.15)):
        write_shapenet(root, "02946921", f"can{index}", cylinder(0.03, height))
    leaking = cylinder(0.03, 0.1)
    leaking.update_faces(leaking.triangles_center[:, 0] < 0.01)
    write_shapenet(root, "02946921", "leaking", leaking)
    (write_shapenet(root, "02946921", "broken", cylinder(0.03, 0.1))).write_bytes(b"\x00 not a mesh")
    write_shapenet(root, "04379243", "table", cylinder(0.5, 0.7))
    (root / "mug").mkdir()
    for seed in range(2):
        parameters = sample_parameters("mug", "train", np.random.default_rng(seed))
        turned = make_solid(parameters).mesh().copy()
        turned.apply_transform(trimesh.transformations.rotation_matrix(2.0, (0, 0, 1)))
        turned.export(root / "mug" / f"{seed}.ply")
    return root


def test_both_layouts_are_found(folder):
    files, skipped = find_meshes(folder)
    assert [file.category for file in files] == ["can"] * 5 + ["mug"] * 2
    assert [file.y_up for file in files] == [True] * 5 + [False] * 2
    assert len(skipped) == 1 and "04379243" in skipped[0] and "neither a class" in skipped[0]


def test_what_cannot_be_used_is_left_out_and_said(folder):
    shapes = load_shapes(folder, seed=0)
    assert len(shapes.train.of("can")) == 2 and len(shapes.test.of("can")) == 1
    assert len(shapes.train.of("mug")) == 1 and len(shapes.test.of("mug")) == 1
    said = "\n".join(shapes.skipped)
    assert "leaking" in said and "not watertight" in said
    assert "broken" in said and len(shapes.skipped) == 3


def test_the_grid_is_that_of_the_projects_conventions(tmp_path):
    """y up, any scale and any turn of the handle: the grid is that of the family's own solid."""
    parameters = sample_parameters("mug", "train", np.random.default_rng(SEED))
    mesh = make_solid(parameters).mesh().copy()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-1.1, (0, 0, 1)))
    path = write_shapenet(tmp_path, "03797390", "one", mesh)
    grid = mesh_grid(MeshFile(path, "mug", y_up=True)) / 255
    expected = solid_grid(make_solid(parameters))
    a, b = grid > 0.5, expected > 0.5
    assert np.count_nonzero(a & b) / np.count_nonzero(a | b) > 0.85
    assert abs(grid.sum() / expected.sum() - 1) < 0.03
    ends = np.flatnonzero(grid.max(axis=(0, 1)) > 0.5)
    assert 31 - ends[-1] == pytest.approx(ends[0], abs=1)  # the bounding box is centred


def test_folders_without_anything_to_learn_from_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match=r"nothing is no folder: expected DIR/<synset>"):
        load_shapes(tmp_path / "nothing", seed=0)
    with pytest.raises(InvalidInputError, match="holds no meshes"):
        load_shapes(tmp_path, seed=0)
    path = write_shapenet(tmp_path, "02946921", "one", cylinder(0.03, 0.1))
    path.write_text("")
    with pytest.raises(InvalidInputError, match=r"none of the 1 meshes .* can be used; the first: .*one"):
        load_shapes(tmp_path, seed=0)


def test_training_on_a_users_meshes(folder, tmp_path, capsys):
    out = tmp_path / "out"
    command = ["train", "shape", "--meshes", str(folder), "--epochs", "1", "--out", str(out)]
    assert run([*command, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["warnings"]) == 3 and report["metrics"]["held_out"]["mug"]["n"] == 1
    card = (out / "shape.md").read_text()
    assert "1 mugs, 0 bowls, 0 bottles, 2 cans, from a user's folder of meshes" in card
    assert str(folder) not in card and str(folder).encode() not in (out / "shape.safetensors").read_bytes()
    for name in ("reconstructions", "walk", "pixel_derivative", "code_derivatives"):
        assert (out / f"shape_{name}.png").stat().st_size > 1000
        assert f"](shape_{name}.png)" in card
    assert run([*command, "--seed", "1"]) == 2
    assert "other meshes or another seed" in capsys.readouterr().err


def test_meshes_are_for_shapes_only(tmp_path, capsys):
    assert run(["train", "yaw", "--meshes", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "`train shape`" in capsys.readouterr().err
