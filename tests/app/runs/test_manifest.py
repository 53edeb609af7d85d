"""Which files belong to a run."""

import json
import os

import pytest

from app.runs.manifest import (
    CARD_FILE,
    CARD_MARK,
    MANIFEST_FILE,
    Manifest,
    linked_folder,
    own_files,
    own_names,
    read_manifest,
    temporary_files,
)
from app.runs.report import Report

OWN = (
    "report.json", "objects.json", "video.webp", "video.mp4", "trajectory.txt", "episodes.jsonl",
    "rows.jsonl", "scene.xml", "replay.npz", "scan/rgb/000000.png", "scan/depth/000012.png",
    "scan/scene_camera.json",
    "objects/3_mug.ply", "meshes/mug_3.obj", "meshes/mug_3_collision_000.obj", "urdf/scene.urdf",
    "urdf/meshes/can_1_collision_001.obj", "pictures/000000.png", "sequences/scene_0/rgb/000001.png",
    "sequences/scene_0/ground_truth/objects/can_2.ply", "shape.safetensors", "checkpoint_class.pt",
    "member1/checkpoint_yaw.pt", "scenes/train_n8_000.npz", "objects_mug.png", "error.log",
    "pose_scenes/crops_train_seed0_n100_000.npz", "pose.md", "axis.safetensors",
    "axis_scenes/crops_test_seed0_n100_000.npz", "fits/fits_test_seed0_n20_000.json",
    "train_shapes/train_mug_seed0_first0_n500.npz", "member1/mapped/training/images.npy",
    "second/checkpoint_class.pt", "second/events.out.tfevents.1.host.2",
    "second/member1/mapped/training/images.npy",
)  # fmt: skip
FOREIGN = (
    "notes.txt", "Report.json", "report.json.bak", "scan/mine.png", "scan/rgb/cat.png", "scan/notes.txt",
    "objects/mine.ply", "meshes/mine.stl", "meshes/can/c.ply", "pictures/wedding.jpg", "sub/report.json",
    "data.jsonl", "thesis.md", ".git/report.json",
)  # fmt: skip


@pytest.fixture
def filled(tmp_path):
    for name in (*OWN, *FOREIGN):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("12345")
    return tmp_path


def test_only_names_that_a_command_writes_belong_to_a_run(filled):
    assert own_files(filled) == dict.fromkeys(OWN, 5)
    assert sorted(own_names(filled)) == sorted(OWN)


def test_links_are_no_files_of_a_run(tmp_path):
    (tmp_path / "mine").write_text("")
    (tmp_path / "report.json").symlink_to("mine")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "000000.png").touch()
    (tmp_path / "pictures").symlink_to("elsewhere")
    assert own_files(tmp_path) == {} and own_names(tmp_path) == ["report.json"]
    assert linked_folder(tmp_path) == tmp_path / "pictures"
    (tmp_path / "pictures").unlink()
    assert linked_folder(tmp_path) is None


def test_a_manifest_is_read_back(tmp_path):
    manifest = Manifest("pack", "complete", {"scan/rgb/000000.png": 7, "report.json": 3})
    manifest.write(tmp_path)
    assert read_manifest(tmp_path) == manifest


def test_changed_and_unlisted_files_are_not_the_runs(tmp_path):
    for name in ("report.json", "plan.json"):
        (tmp_path / name).write_text("123")
    manifest = Manifest("pack", "complete", {"report.json": 3})
    assert manifest.owns(tmp_path, "report.json") and not manifest.owns(tmp_path, "plan.json")
    (tmp_path / "report.json").write_text("1234")
    assert not manifest.owns(tmp_path, "report.json")
    assert Manifest("pack", "running", {}).owns(tmp_path, "plan.json")  # killed before it was recorded


def test_the_card_of_a_data_set_is_of_a_run_and_other_readme_files_are_not(tmp_path):
    (tmp_path / CARD_FILE).write_text(f"# Title\n\n{CARD_MARK} 1.0, made with\n")
    assert own_names(tmp_path) == [CARD_FILE]
    (tmp_path / CARD_FILE).write_text("my notes")
    assert own_names(tmp_path) == []
    (tmp_path / CARD_FILE).unlink()
    os.mkfifo(tmp_path / CARD_FILE)
    assert own_names(tmp_path) == []


def test_a_run_without_a_manifest_is_known_by_its_report(filled):
    assert read_manifest(filled) is None
    (filled / "report.json").write_text(json.dumps({"tool": "pytest", "passed": 3}))
    assert read_manifest(filled) is None
    (filled / "report.json").write_text(Report("sort", 4).to_json())
    found = read_manifest(filled)
    assert found is not None and (found.command, found.state) == ("sort", "complete")
    assert set(found.files) == set(OWN)


@pytest.mark.parametrize("key", sorted(Report("pack", 0).as_json().keys() - {"warnings", "settings"}))
def test_a_report_of_another_program_is_none_of_ours(tmp_path, key):
    (tmp_path / "report.json").write_text(json.dumps(Report("pack", 0).as_json() | {key: None}))
    assert read_manifest(tmp_path) is None


@pytest.mark.parametrize("content", ["", "[]", "{", "{}", '{"nodeslam_manifest": 1}', '"x"', "[" * 100000])
def test_a_damaged_manifest_claims_nothing(tmp_path, content):
    (tmp_path / MANIFEST_FILE).write_text(content)
    (tmp_path / "report.json").write_text(Report("pack", 0).to_json())
    assert read_manifest(tmp_path) is None


def test_temporary_files_are_those_of_files_of_a_run(tmp_path):
    temporary = (
        ".report.json.a1b2c3d4", ".video.mp4.partial.mp4", ".video.partial.webp",
        "scan/rgb/.000003.png.abcdefgh", f".{MANIFEST_FILE}.abcdefgh", "scenes/train_n8_000.partial.npz",
        "train_shapes.tmp.npz",
    )  # fmt: skip
    foreign = (
        ".bashrc",
        ".notes.txt.abcdefgh",
        ".report.json.swp",
        "mine/.report.json.a1b2c3d4",
        "x.partial.npz",
    )
    for name in (*temporary, *foreign):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert sorted(temporary_files(tmp_path)) == sorted(tmp_path / name for name in temporary)


@pytest.mark.parametrize("name", [MANIFEST_FILE, "report.json"])
def test_a_pipe_in_place_of_a_manifest_or_report_claims_nothing(tmp_path, name):
    os.mkfifo(tmp_path / name)  # reading it would block
    assert read_manifest(tmp_path) is None
