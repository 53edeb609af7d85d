"""The score of the BOP toolkit for our poses, on a data set of the simulated cell with ground truth.

    git clone https://github.com/thodan/bop_toolkit     # and its packages, in an environment of its own
    python -m tests.bop_score --toolkit bop_toolkit --python .bop/bin/python --out runs/bop [--seed 5200]

Writes six scenes with one mug, bowl, bottle and can of the test families each, in six images, as a BOP data
set. The toolkit knows a fixed list of data sets: ours takes the name of one of six such scenes, icmi, whose
objects 5 and 6 stay unused. ``nodeslam reconstruct`` is run on every scene. With ``--slam``, the scenes have
25 images for each second of the scan, and ``nodeslam slam`` gets no camera pose but the first. The files
bop.csv together are then scored by the toolkit's own ``eval_bop19_pose.py``: VSD, MSSD and MSPD. Bowl, bottle
and can are bodies of revolution, and declared so.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from scipy.spatial import KDTree

from app.options import ScanOptions
from app.task.cell import build_world
from app.task.restricted_robot import restricted
from app.task.scoring import Truth, read_truth
from manipulation.kinematics import Kinematics
from manipulation.viewpoints import ViewpointScanner
from manipulation.workspace import Workspace
from perception.io.bop_results import HEADER, OBJECT_IDS
from perception.io.scan_folder import write_scan
from perception.types import CATEGORIES, RgbdFrame
from sim_assets.cell.world import IMAGE_SIZE
from sim_assets.objects import sample_object

DATA_SET, SCENES, MODELS = "icmi", range(1, 7), range(1, 7)
LEAST_VISIBLE = 0.1
ROUND = 0.0015  # [m]: largest distance of a turned body of revolution from samples of itself


def draw_objects(folder: Path, seed: int) -> None:
    """Write one mesh per class: the first mug, and the first others that are bodies of revolution."""
    rng = np.random.default_rng(seed)
    for category in CATEGORIES:
        mesh = None
        while mesh is None or (category != "mug" and not is_body_of_revolution(mesh)):
            mesh = sample_object(category, "test", rng).mesh
        (folder / category).mkdir(parents=True, exist_ok=True)
        mesh.export(folder / category / f"{category}.ply")


def is_body_of_revolution(mesh: trimesh.Trimesh) -> bool:
    """Return whether the vertices, turned by 1 rad about z, are on the surface."""
    turned = trimesh.transform_points(mesh.vertices, trimesh.transformations.rotation_matrix(1.0, [0, 0, 1]))
    points = trimesh.sample.sample_surface(mesh, 400_000, seed=0)[0]
    return bool(KDTree(points).query(turned)[0].max() < ROUND)


def write_models(folder: Path, truth: Truth) -> None:
    """Write the true models in millimetres, their origin in the centre of the bounding box."""
    information: dict[str, dict[str, Any]] = {}
    for model in truth.models.values():
        mesh = trimesh.Trimesh(*_centred(model.mesh))
        low, high = mesh.bounds
        sizes = zip(("size_x", "size_y", "size_z"), (high - low).tolist())
        lows = zip(("min_x", "min_y", "min_z"), low.tolist())
        diameter = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices, axis=-1).max()
        entry = {"diameter": float(diameter), **dict(lows), **dict(sizes)}
        if model.category != "mug":
            entry["symmetries_continuous"] = [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
        information[str(OBJECT_IDS[model.category])] = entry
        _write_model(folder, OBJECT_IDS[model.category], mesh)
    for unused in set(MODELS) - set(OBJECT_IDS.values()):
        information[str(unused)] = information["1"]
        _write_model(folder, unused, mesh)
    for name in ("models", "models_eval"):
        (folder / name / "models_info.json").write_text(json.dumps(information))


def _centred(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return 1000 * (np.asarray(mesh.vertices) - mesh.bounds.mean(axis=0)), np.asarray(mesh.faces)


def _write_model(folder: Path, number: int, mesh: trimesh.Trimesh) -> None:
    mesh.vertex_normals  # noqa: B018  the toolkit needs normals in the file
    for name in ("models", "models_eval"):
        (folder / name).mkdir(parents=True, exist_ok=True)
        mesh.export(folder / name / f"obj_{number:06d}.ply", vertex_normal=True, encoding="ascii")


def record(seed: int, meshes: Path, sequence: bool) -> tuple[list[RgbdFrame], Truth]:
    """Return the images at the viewpoints of a scan, or those of the whole motion, and the truth."""
    each = ",".join(f"{category}=1" for category in CATEGORIES)
    with build_world(ScanOptions(seed=seed, objects=each, object_meshes=meshes), "pack") as world:
        space = Workspace(world.config.scale)
        kinematics = Kinematics(world.arm)
        scanner = ViewpointScanner(
            restricted(world), kinematics, keep_out=space.keep_out, via_heights=space.via_heights
        )
        frames: list[RgbdFrame] = []
        if sequence:
            world.observe(lambda _: frames.append(scanner.look()))
        views = scanner.capture(space.scan_viewpoints())
        world.observe(None)
        return frames or views, read_truth(world)


def true_poses(frame: RgbdFrame, truth: Truth) -> list[dict[str, Any]]:
    """Return the entries of ``scene_gt.json`` for an image, in millimetres."""
    assert frame.T_world_camera is not None
    entries = []
    for number, model in truth.models.items():
        T_object_model = np.eye(4)
        T_object_model[:3, 3] = model.mesh.bounds.mean(axis=0)
        T = np.linalg.inv(frame.T_world_camera) @ truth.poses[number] @ T_object_model
        entries.append({
            "cam_R_m2c": T[:3, :3].ravel().tolist(),
            "cam_t_m2c": (1000 * T[:3, 3]).tolist(),
            "obj_id": OBJECT_IDS[model.category],
        })  # fmt: skip
    return entries


def write_data_set(out: Path, seed: int, sequences: bool) -> None:
    """Write images, models and true poses."""
    folder, meshes = out / DATA_SET, out / "meshes"
    draw_objects(meshes, seed)
    for scene in SCENES:
        frames, truth = record(seed + scene, meshes, sequences)
        place = folder / "test" / f"{scene:06d}"
        write_scan(place, frames)
        poses = {str(i): true_poses(frame, truth) for i, frame in enumerate(frames)}
        (place / "scene_gt.json").write_text(json.dumps(poses))
        if scene == SCENES[0]:
            write_models(folder, truth)
            camera = frames[0].intrinsics
            values = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
                      "width": camera.width, "height": camera.height, "depth_scale": 0.1}  # fmt: skip
            (folder / "camera.json").write_text(json.dumps(values))


def write_visibility(folder: Path, scene: int) -> list[dict[str, int]]:
    """Write ``scene_gt_info.json`` of a scene from the toolkit's masks; return the targets in it.

    As in the BOP challenge, objects of which a tenth is visible are targets; what is beyond the border of the
    image counts as invisible.
    """
    place = folder / "test" / f"{scene:06d}"
    cameras = json.loads((place / "scene_camera.json").read_text())
    information, targets = {}, []
    for i, entries in json.loads((place / "scene_gt.json").read_text()).items():
        K = np.reshape(cameras[i]["cam_K"], (3, 3))
        information[i] = []
        for number, entry in enumerate(entries):
            name = f"{int(i):06d}_{number:06d}.png"
            silhouette, visible = (_area(place / kind / name) for kind in ("mask", "mask_visib"))
            share = visible / max(silhouette, 1) * _share_in_image(folder, entry, K)
            information[i].append(
                {"px_count_all": silhouette, "px_count_visib": visible, "visib_fract": share}
            )
            if share >= LEAST_VISIBLE:
                target = {"im_id": int(i), "inst_count": 1, "obj_id": entry["obj_id"], "scene_id": scene}
                targets.append(target)
    (place / "scene_gt_info.json").write_text(json.dumps(information))
    return targets


def _share_in_image(folder: Path, entry: dict[str, Any], K: np.ndarray) -> float:
    """Return the share of the convex hull of an object's projection that is within the image."""
    vertices = _vertices(folder / "models" / f"obj_{entry['obj_id']:06d}.ply")
    points = vertices @ np.reshape(entry["cam_R_m2c"], (3, 3)).T + entry["cam_t_m2c"]
    if points[:, 2].min() <= 0:  # beside or behind the camera
        return 0.0
    width, height = IMAGE_SIZE
    hull = cv2.convexHull(((points @ K.T)[:, :2] / points[:, 2:]).astype(np.float32))
    image = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    return cv2.intersectConvexConvex(hull, image)[0] / cv2.contourArea(hull)


@functools.cache
def _vertices(path: Path) -> np.ndarray:
    return np.asarray(trimesh.load_mesh(path).vertices)


def _area(mask: Path) -> int:
    image = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
    assert image is not None, mask
    return int(np.count_nonzero(image))


def estimate(out: Path, command: str) -> Path:
    """Run the command on every scene; return the file with the lines of all bop.csv."""
    lines = [HEADER]
    for scene in SCENES:
        place, run = out / DATA_SET / "test" / f"{scene:06d}", out / command / f"{scene:06d}"
        subprocess.run(
            [sys.executable, "-m", "app", command, str(place), "--out", str(run), "--quiet"], check=True
        )
        lines += (run / "bop.csv").read_text().splitlines()[1:]
    path = out / "results" / f"nodeslam-{command}_{DATA_SET}-test.csv"
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def score(out: Path, toolkit: Path, python: str, path: Path) -> dict[str, Any]:
    """Return what the toolkit computes."""
    environment = os.environ | {
        "BOP_PATH": str(out.resolve()), "BOP_RESULTS_PATH": str((out / "results").resolve()),
        "BOP_EVAL_PATH": str((out / "scores").resolve()), "BOP_NUM_WORKERS": "2",
        "PYTHONPATH": str(toolkit.resolve()), "EGL_PLATFORM": "surfaceless",  # for vispy without a display
        "PATH": f"{Path(python).absolute().parent}:{os.environ['PATH']}",
    }  # fmt: skip

    def run(script: str, *arguments: str) -> None:
        command = [python, str(toolkit.resolve() / "scripts" / script), *arguments]
        subprocess.run(command, check=True, env=environment, cwd=toolkit)

    targets_file = out / DATA_SET / "test_targets_bop19.json"
    targets_file.write_text("[]")  # the masks are those of all poses, but the toolkit reads the file
    run("calc_gt_masks.py", "--dataset", DATA_SET)
    targets = [target for scene in SCENES for target in write_visibility(out / DATA_SET, scene)]
    targets_file.write_text(json.dumps(targets))
    run("eval_bop19_pose.py", "--result_filenames", path.name)
    return json.loads((out / "scores" / path.stem / "scores_bop19.json").read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--toolkit", type=Path, required=True)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=5200)
    parser.add_argument("--slam", action="store_true")
    options = parser.parse_args()
    if not (options.out / DATA_SET / "test" / f"{SCENES[-1]:06d}" / "scene_gt.json").exists():
        write_data_set(options.out, options.seed, options.slam)
    results = estimate(options.out, "slam" if options.slam else "reconstruct")
    for name, value in score(options.out, options.toolkit, options.python, results).items():
        print(f"{name}: {value:.4f}")  # noqa: T201


if __name__ == "__main__":
    main()
