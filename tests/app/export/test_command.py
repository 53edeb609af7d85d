"""Exported models: they load, weigh what they should, and stand after a drop."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
import pytest
import trimesh

from app.cli import run
from app.export.model import DENSITIES
from perception.io.object_map import write_object_map
from perception.types import ObjectEstimate
from sim_assets.rendering.headless import mujoco

PLACES = {"mug": (0.4, -0.3), "bowl": (0.6, -0.3), "bottle": (0.4, -0.1), "can": (0.6, -0.1)}
DROP = 0.01  # [m]


@pytest.fixture
def source(tmp_path: Path, standing: Callable[..., ObjectEstimate]) -> Path:
    """A run folder with one object of each class."""
    objects = [standing(category, number, at) for number, (category, at) in enumerate(PLACES.items())]
    write_object_map(tmp_path / "run", objects)
    return tmp_path / "run"


def export(source: Path, form: str) -> Path:
    out = source.parent / form
    assert run(["export", str(source), "--format", form, "--out", str(out), "--quiet"]) == 0
    return out


def names(source: Path) -> dict[str, dict]:
    entries = json.loads((source / "objects.json").read_text())
    return {f"{entry['category']}_{entry['id']}": entry for entry in entries}


def assert_stands_after_a_drop(model, objects: dict[str, dict]) -> None:
    data = mujoco.MjData(model)
    for name in objects:
        data.qpos[model.body(name).jntadr[0] * 7 + 2] += DROP
    for _ in range(round(1.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    for name, entry in objects.items():
        place = np.array(entry["T_world_object"])[:3, 3]
        assert data.body(name).xmat.reshape(3, 3)[2, 2] > np.cos(np.deg2rad(2)), name
        assert np.linalg.norm(data.body(name).xpos[:2] - place[:2]) < 0.005, name
        assert np.abs(data.qvel).max() < 0.02, name


def extents(model, name: str) -> np.ndarray:
    """Of a visual geom at the start, in the world."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = model.geom(name)
    first = model.mesh_vertadr[geom.dataid[0]]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[geom.dataid[0]]]
    return np.ptp(vertices @ data.geom(name).xmat.reshape(3, 3).T, axis=0)


def test_mjcf_loads_and_objects_rest_upright_within_a_second(source: Path) -> None:
    folder = export(source, "mjcf")
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    objects = names(source)
    for name, entry in objects.items():
        map_mesh = trimesh.load(source / "objects" / f"{entry['id']}_{entry['category']}.ply")
        expected = DENSITIES[entry["category"]] * map_mesh.volume
        assert model.body(name).mass[0] == pytest.approx(expected, rel=0.02)
        np.testing.assert_allclose(extents(model, name), map_mesh.extents, rtol=0.02)
    assert_stands_after_a_drop(model, objects)


def test_urdf_loads_rests_upright_and_agrees_with_the_map(source: Path) -> None:
    folder = export(source, "urdf") / "urdf"
    spec = mujoco.MjSpec.from_file(str(folder / "scene.urdf"))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(2, 2, 0.1))
    assert_stands_after_a_drop(spec.compile(), names(source))
    for name, entry in names(source).items():
        link = xml.parse(folder / f"{name}.urdf").getroot().find("link")
        assert link is not None
        look = trimesh.load(folder / link.find("visual/geometry/mesh").get("filename"), force="mesh")
        assert look.is_watertight and look.extents[2] == pytest.approx(entry["height"], rel=0.02)
        mass = float(link.find("inertial/mass").get("value"))
        assert mass == pytest.approx(DENSITIES[entry["category"]] * look.volume, rel=0.02)
        files = [mesh.get("filename") for mesh in link.findall("collision/geometry/mesh")]
        parts = [trimesh.load(folder / file, force="mesh") for file in files]
        assert sum(part.volume for part in parts) == pytest.approx(look.volume, rel=0.02)
        assert sum(part.convex_hull.volume for part in parts[::9]) == pytest.approx(
            sum(part.volume for part in parts[::9]), rel=1e-3
        )


def test_glb_has_named_nodes_and_class_colours(source: Path) -> None:
    scene = trimesh.load(export(source, "glb") / "scene.glb")
    objects = names(source)
    assert set(objects) <= set(scene.graph.nodes)
    colors = set()
    for name, entry in objects.items():
        T, geometry = scene.graph[name]
        mesh = scene.geometry[geometry]
        assert mesh.extents[2] == pytest.approx(entry["height"], rel=0.02)
        y_up = np.array(entry["T_world_object"])[:3, 3][[0, 2, 1]] * (1, 1, -1)
        np.testing.assert_allclose(T[:3, 3], y_up, atol=1e-6)
        colors.add(tuple(mesh.visual.material.baseColorFactor))
    assert len(colors) == len(objects)


def test_folders_that_are_no_runs_end_in_one_line(
    tmp_path: Path, source: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare" / "objects.json").write_text("[]")
    for folder, words in (
        (tmp_path / "empty", "objects.json is missing"),
        (tmp_path / "missing", "is not a folder"),
        (tmp_path / "bare", "holds no object"),
    ):
        assert run(["export", str(folder), "--out", str(tmp_path / "out")]) == 2
        message = capsys.readouterr().err.strip()
        assert words in message and "\n" not in message
    assert run(["export", str(source), "--out", str(source)]) == 2
    assert "is the input itself" in capsys.readouterr().err
