"""``nodeslam convert``: TUM RGB-D, NOCS and numbered recordings become scan folders."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from app.cli import run
from perception.io.images import png_bytes
from perception.io.recordings.trajectory import Trajectory, write_trajectory
from perception.io.scan_folder import read_scan


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png_bytes(image))


def tum(folder: Path, count: int = 6) -> Path:
    """Colour every 0.1 s, depth 5 ms later, poses 2 ms after that; the last depth image has no pose."""
    colours, depths = [], []
    for i in range(count):
        time = 100 + 0.1 * i
        save(folder / f"rgb/{time:.3f}.png", np.full((48, 64, 3), 10 * i, np.uint8))
        save(folder / f"depth/{time + 0.005:.3f}.png", np.full((48, 64), 5000 + 100 * i, np.uint16))
        colours.append(f"{time:.3f} rgb/{time:.3f}.png")
        depths.append(f"{time + 0.005:.3f} depth/{time + 0.005:.3f}.png")
    (folder / "rgb.txt").write_text("# color images\n" + "\n".join(colours) + "\n")
    (folder / "depth.txt").write_text("# depth maps\n" + "\n".join(depths) + "\n")
    poses = [np.eye(4) for _ in range(count - 1)]
    for i, T in enumerate(poses):
        T[0, 3] = 0.1 * i
    write_trajectory(
        folder / "groundtruth.txt", Trajectory.of([100.007 + 0.1 * i for i in range(count - 1)], poses)
    )
    return folder


def convert(source: Path, out: Path, *options: str) -> int:
    return run(["convert", str(source), "--out", str(out), "--quiet", *options])


def test_tum_recording_becomes_a_posed_scan(tmp_path: Path) -> None:
    assert convert(tum(tmp_path / "rgbd_freiburg1_desk"), tmp_path / "out") == 0
    scan = read_scan(tmp_path / "out/scan")
    assert scan.has_poses and len(scan.frames) == 5
    for i, frame in enumerate(scan.frames):
        assert frame.depth.max() == pytest.approx(1.0 + 0.02 * i, abs=1e-4)
        assert frame.T_world_camera is not None and frame.T_world_camera[0, 3] == pytest.approx(0.1 * i)
        assert (frame.rgb == 10 * i).all()
    assert scan.frames[0].intrinsics.fx == pytest.approx(517.3 / 10)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert len(report["warnings"]) == 1 and "has no pose" in report["warnings"][0]


def test_images_are_chosen_evenly_and_the_camera_may_be_given(tmp_path: Path) -> None:
    source = tum(tmp_path / "mine", 6)
    (source / "groundtruth.txt").unlink()
    assert convert(source, tmp_path / "out", "--images", "2", "--camera", "60,61,32,24") == 0
    scan = read_scan(tmp_path / "out/scan")
    assert not scan.has_poses and [int(f.rgb[0, 0, 0]) for f in scan.frames] == [0, 50]
    assert scan.frames[0].intrinsics.fy == pytest.approx(61.0)


def test_nocs_frames_bring_their_detections(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    save(folder / "0000_color.png", np.full((48, 64, 3), 100, np.uint8))
    save(folder / "0000_depth.png", np.full((48, 64), 850, np.uint16))
    mask = np.full((48, 64), 255, np.uint8)
    mask[10:20, 10:20] = 1
    save(folder / "0000_mask.png", mask)
    (folder / "0000_meta.txt").write_text("1 6 mug_a\n")
    assert convert(folder, tmp_path / "out") == 0
    scan = read_scan(tmp_path / "out/scan")
    assert scan.detections is not None and scan.detections[0][0].category == "mug"
    np.testing.assert_array_equal(scan.detections[0][0].mask, mask == 1)


def test_numbered_images_with_poses(tmp_path: Path) -> None:
    folder = tmp_path / "kitchen"
    for k in range(3):
        save(folder / f"frame-{k:06d}.color.png", np.full((48, 64, 3), k, np.uint8))
        save(folder / f"frame-{k:06d}.depth.png", np.full((48, 64), 800, np.uint16))
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", np.eye(4) if k else np.full((4, 4), np.nan))
    (folder / "camera-intrinsics.txt").write_text("60 0 32\n0 60 24\n0 0 1\n")
    assert convert(folder, tmp_path / "out", "--depth-scale", "0.5") == 0
    scan = read_scan(tmp_path / "out/scan")
    assert scan.has_poses and len(scan.frames) == 2
    assert scan.frames[0].depth.max() == pytest.approx(0.4) and scan.frames[0].intrinsics.fx == 60
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["metrics"]["median_depth"] == pytest.approx(0.4)
    assert len(report["warnings"]) == 1 and "frame-000000.pose.txt" in report["warnings"][0]


def test_an_implausible_unit_of_depth_is_reported(tmp_path: Path) -> None:
    assert convert(tum(tmp_path / "mine"), tmp_path / "out", "--depth-scale", "5") == 0
    assert "check --depth-scale" in json.loads((tmp_path / "out/report.json").read_text())["warnings"][-1]


def test_listed_images_without_files_are_reported(tmp_path: Path) -> None:
    source = tum(tmp_path / "mine")
    (source / "rgb/100.200.png").unlink()
    assert convert(source, tmp_path / "out") == 0
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert "1 listed image pairs have no files" in report["warnings"] and report["metrics"]["n_images"] == 4


def test_bad_sources_end_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tum(tmp_path / "mine")
    (tmp_path / "empty").mkdir()
    (tmp_path / "done").mkdir()
    (tmp_path / "done/scene_camera.json").write_text("{}")
    for arguments, words in (
        ([tmp_path / "empty"], "holds no recording that is known: rgb.txt"),
        ([tmp_path / "missing"], "is no folder"),
        ([source, "--camera", "600,600"], "--camera takes fx,fy,cx,cy"),
        ([source, "--camera", "600,600,-1,2"], "must be positive"),
        ([source, "--images", "0"], "must be in 1.."),
        ([source, "--depth-scale", "0"], "--depth-scale 0 must be in 0.001..100"),
        ([source, "--camera", "1e300,1e300,32,24"], "s: focal lengths 1e+300, 1e+300 px are implausible"),
        ([source, "--camera", "600,600,320,240"], "lies outside the images of 64x48 px"),
        ([tmp_path / "done"], "is a scan folder already"),
    ):
        assert run(["convert", *map(str, arguments), "--out", str(tmp_path / "out")]) == 2
        message = capsys.readouterr().err.strip()
        assert words in message and "\n" not in message
    (source / "rgb.txt").write_text("nonsense\n")
    assert run(["convert", str(source), "--out", str(tmp_path / "out")]) == 2
    assert "rgb.txt, line 1" in capsys.readouterr().err
