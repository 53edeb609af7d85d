"""``nodeslam slam SEQUENCE``: object map and camera trajectory of an RGB-D sequence; needs no simulator."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from app.options import SlamOptions
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.slam.pictures import MappedSequence, write_map_picture
from app.slam.recording import SlamRecorder
from app.slam.run import SlamRun
from app.slam.sequence_truth import read_true_trajectory
from perception.io.bop_results import write_bop_results
from perception.io.files import write_json
from perception.io.object_map import write_object_map
from perception.io.recordings.sequence import open_sequence
from perception.io.recordings.trajectory import Trajectory, write_trajectory
from perception.io.scan_folder import write_scan
from perception.pipeline import load_decoder, load_detector
from perception.slam.config import SlamConfig
from perception.slam.estimates import object_estimates
from perception.slam.keyframes import Keyframe
from perception.types import ObjectDetection, ObjectEstimate


def run(options: SlamOptions, screen: Screen) -> Report:
    """Run SLAM on the sequence; an interruption keeps the map and the trajectory so far."""
    begin = time.perf_counter()
    sequence, truth = open_sequence(options.sequence), read_true_trajectory(options.sequence)
    folder = RunFolder.create(options, "slam")
    with screen.stage("Loading networks"):
        decoder = load_decoder(options.device)
        detector = None if sequence.entries is not None else load_detector(options.device)
    config = SlamConfig().objects_only() if options.objects_only else SlamConfig()
    slam_run, recorder = SlamRun.start(sequence, decoder, detector, config), SlamRecorder()
    interrupted = False
    with screen.stage("Mapping and tracking"):
        try:
            for done, (_, result) in enumerate(slam_run.steps(), start=1):
                recorder.add(result, slam_run.slam)
                screen.update(_progress(done, slam_run))
        except KeyboardInterrupt:
            interrupted = True
    with screen.stage("Writing the map"):
        objects = _write(folder, slam_run, recorder, decoder, truth)
    report = _report(options, slam_run, objects, time.perf_counter() - begin, interrupted)
    folder.write_report(report)
    if interrupted:
        raise KeyboardInterrupt
    screen.show(_table(report))
    screen.show(escape(f"map in {folder.path / 'objects'}, trajectory.txt, overview.png in {folder.path}"))
    return report


def _progress(done: int, slam_run: SlamRun) -> str:
    world, last = slam_run.slam.world, slam_run.results[-1]
    count = len(world.landmarks) if world else 0
    lost = ", LOST" if last.status == "lost" else ""
    return (
        f"frame {done} of {len(slam_run.sequence)}, {slam_run.frame_rate:.0f} frames/s tracked, "
        f"{count} objects, {len(slam_run.slam.keyframes)} keyframes{lost}"
    )


def _write(
    folder: RunFolder, slam_run: SlamRun, recorder: SlamRecorder, decoder: Any, truth: Trajectory | None
) -> list[ObjectEstimate]:
    """Write all files of a run, complete or interrupted, and return the objects of the map."""
    slam = slam_run.slam
    objects = [] if slam.world is None else object_estimates(slam.world, decoder)
    write_object_map(folder.path, objects)
    write_trajectory(folder.path / "trajectory.txt", slam_run.trajectory)
    seconds = sum(sum(result.seconds.values()) for result in slam_run.results)
    write_bop_results(folder.path / "bop.csv", slam_run.sequence.path, objects, slam_run.images, seconds)
    known = {o.id: o for o in objects}
    write_scan(
        folder.scan, [k.frame for k in slam.keyframes], [_detections(k, known) for k in slam.keyframes]
    )
    write_json(
        folder.path / "keyframes.json",
        [
            {
                "number": k.number,
                "time": k.frame.time,
                "T_world_camera": k.T_world_camera.tolist(),
                "objects": sorted(k.landmark_ids & set(known)),
            }
            for k in slam.keyframes
        ],
    )
    recorder.write(folder.path)
    title = f"{len(objects)} objects, {len(slam_run.results)} frames, {len(slam.keyframes)} keyframes"
    mapped = MappedSequence(objects, slam_run.trajectory, slam.keyframes, truth)
    write_map_picture(folder.path / "overview.png", mapped, title)
    return objects


def _detections(key: Keyframe, known: Mapping[int, ObjectEstimate]) -> list[ObjectDetection]:
    """Return the masks of the objects of the final map in a keyframe."""
    return [
        ObjectDetection(known[id].category, min(known[id].score, 1.0), key.labels == label, instance_id=id)
        for label, id in key.landmark_of.items()
        if id in known and (key.labels == label).any()
    ]


def _report(
    options: SlamOptions, slam_run: SlamRun, objects: list[ObjectEstimate], seconds: float, interrupted: bool
) -> Report:
    results = slam_run.results
    n_lost = sum(r.status == "lost" for r in results)
    ends_lost = bool(results) and results[-1].status == "lost"
    stages = ("detect", "track", "initialise", "joint", "relocalise")
    reason = f"{len(objects)} objects, {len(results) - n_lost} of {len(results)} frames tracked"
    if interrupted:
        reason = f"interrupted: {reason}"
    elif ends_lost:
        reason = f"lost at the end: {reason}"
    return Report(
        command="slam",
        seed=options.seed,
        success=bool(objects) and not ends_lost and not interrupted,
        reason=reason,
        timings={stage: float(sum(slam_run.seconds(stage))) for stage in stages} | {"total": seconds},
        objects=[ObjectReport(o.id, o.category, details=_details(o)) for o in objects],
        metrics={
            "n_frames": len(results),
            "n_lost": n_lost,
            "n_keyframes": len(slam_run.slam.keyframes),
            "n_detected": sum(r.is_detected for r in results),
            "tracking_rate": slam_run.frame_rate,
            "loop_rate": slam_run.loop_rate,
            "joint_seconds": float(np.median(slam_run.seconds("joint") or [0.0])),
        },
        warnings=slam_run.warnings,
        settings={"sequence": str(options.sequence), "objects_only": options.objects_only},
    )


def _details(estimate: ObjectEstimate) -> dict[str, float | int]:
    return {
        "height": estimate.height,
        "radius": estimate.radius,
        "score": estimate.score,
        "n_views": estimate.n_views,
    }


def _table(report: Report) -> Table:
    table = Table(title=escape(report.reason), title_justify="left", show_edge=False, pad_edge=False)
    for heading in ("object", "height", "radius", "sure", "frames"):
        table.add_column(heading, justify="left" if heading == "object" else "right")
    for entry in report.objects:
        d = entry.details
        table.add_row(
            f"{entry.category} {entry.id}",
            f"{1000 * d['height']:.0f} mm",
            f"{1000 * d['radius']:.0f} mm",
            f"{100 * d['score']:.0f} %",
            str(d["n_views"]),
        )
    return table
