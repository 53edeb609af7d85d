"""Inputs of a command, and output folders that would destroy them."""

import dataclasses
from pathlib import Path

import pytest

from app.errors import UsageError
from app.options import (
    COMMANDS,
    ArOptions,
    BenchOptions,
    DoctorOptions,
    ReconstructOptions,
    ScanOptions,
    ViewOptions,
)
from app.runs.inputs import inputs_of, require_disjoint


def test_every_option_that_holds_a_path_is_an_input_or_an_output():
    paths = {
        field.name
        for kind in COMMANDS.values()
        for field in dataclasses.fields(kind)
        if "Path" in str(field.type)
    }
    assert paths == {
        "against",
        "arm",
        "hand",
        "hand_eye",
        "html",
        "meshes",
        "object_meshes",
        "out",
        "run",
        "scan",
        "sequence",
        "source",
    }


def test_paths_of_the_options_are_inputs(tmp_path):
    robot = tmp_path / "arm.toml"
    robot.touch()
    assert inputs_of(DoctorOptions(out=tmp_path)) == []
    assert inputs_of(ArOptions(run=Path("a"), out=tmp_path)) == [Path("a")]
    assert inputs_of(BenchOptions(scan=Path("b"))) == [Path("b")]
    assert inputs_of(ReconstructOptions(scan=Path("c"), detector="hf:some/model")) == [Path("c")]
    assert inputs_of(ScanOptions(object_meshes=Path("d"), robot=str(robot))) == [Path("d"), robot]
    assert inputs_of(ScanOptions(robot="x" * 5000)) == []
    assert inputs_of(ViewOptions(run=Path("e"), html=Path("page.html"))) == [Path("e")]


@pytest.mark.parametrize(
    "out, source, relation",
    [
        ("run", "run", "is the input itself"),
        ("run", "run/scan", "contains the input"),
        ("run/new", "run", "lies inside the input"),
        ("link", "run", "is the input itself"),
        ("run/../run/.", "run", "is the input itself"),
        ("run", "link/scan", "contains the input"),
    ],
)
def test_an_output_that_overlaps_an_input_is_refused(tmp_path, out, source, relation):
    (tmp_path / "run" / "scan").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "run")
    with pytest.raises(UsageError, match=relation):
        require_disjoint(tmp_path / out, [tmp_path / source])


def test_neighbours_are_disjoint(tmp_path):
    require_disjoint(tmp_path / "run2", [tmp_path / "run", tmp_path / "run" / "scan"])
    require_disjoint(tmp_path / "run" / "new", [tmp_path / "run" / "scan"])
