"""``nodeslam evaluate slam``: scenes as in the paper, ablations, and comparison with TSDF fusion.

Scene i is determined by the seed: ten objects of the test families on a table and a random smooth trajectory.
Each finished (scene, variant) is one line of ``rows.jsonl``. Sequences are kept in ``sequences/``.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from app.errors import UsageError
from app.evaluation import slam_short
from app.evaluation.ledger import Ledger, LedgerFormat, Line
from app.evaluation.slam_scoring import (
    CURVE_UPDATES,
    TrueObjects,
    absolute_pose_error,
    completion_by_update,
    fused_by_update,
    surface_rows,
)
from app.evaluation.slam_summary import slam_tables, summarise_slam, write_plots
from app.jobs import Failure, Jobs, networks_on, resident_memory, run_jobs
from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen
from app.slam.pictures import MappedSequence, write_map_picture
from app.slam.run import SlamRun
from app.slam.sequence_truth import read_true_objects, read_true_trajectory
from perception.inference.shape_model import Decoder
from perception.io.recordings.sequence import open_sequence
from perception.io.recordings.trajectory import Trajectory
from perception.slam.ablations import Variant, variant_config
from perception.slam.estimates import object_estimates
from perception.slam.landmarks import Landmark

ROWS = "rows.jsonl"
STAGES = ("detect", "track", "initialise", "joint", "relocalise")  # measured in processor seconds
_RESIDENT_EVERY = 50  # frames
CURVES_OF = ("full", "with_plane")  # variants with completion curves


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Run the unfinished (scene, variant) pairs and report on all."""
    if options.short_runs:
        return slam_short.run(options, screen)
    begin = time.perf_counter()
    if options.scenes < 1 or options.frames < 2 or not options.variants:
        raise UsageError("evaluate slam needs a scene, two frames and a variant at least")
    from perception.fusion.tsdf import load_open3d

    load_open3d()
    ledger, finished = Ledger.open(options, _format(options), _settings(options))
    items: list[tuple[int, Variant]] = list(product(range(options.scenes), options.variants))
    to_do = [item for item in items if _key(*item) not in finished]
    if finished:
        screen.note(f"{len(items) - len(to_do)} of {len(items)} runs are already finished")
    jobs = Jobs(to_do, partial(run_scene, options, ledger.folder.path), partial(failed_scene, options))
    with screen.stage(f"{len(to_do)} runs"):
        for line in run_jobs(jobs, options):
            finished[line["key"]] = line
            ledger.append(line)
            ledger.folder.write_report(_report(options, items, finished, time.perf_counter() - begin))
            screen.note(f"{line['key']}: {_brief(line)}")
            screen.update(f"{len(finished)} of {len(items)}")
    report = _report(options, items, finished, time.perf_counter() - begin)
    ledger.folder.write_report(report)
    write_plots(ledger.folder.path, report)
    for table in slam_tables(report):
        screen.show(table)
    return report


def _key(scene: int, variant: Variant) -> str:
    return f"{scene}/{variant}"


def _brief(line: Mapping[str, Any]) -> str:
    if "ape_mean" not in line:
        return str(line["reason"])
    return f"APE {100 * line['ape_mean']:.2f} cm, {line['n_lost']} frames lost, {line['seconds']:.0f} s"


def run_scene(options: EvaluateOptions, folder: Path, item: tuple[int, Variant]) -> Line:
    """Evaluate one variant on one scene."""
    scene, variant = item
    begin = time.perf_counter()
    path = ensure_sequence(options, folder, scene)
    rng = np.random.default_rng([options.seed, scene])
    line = _line_start(options, item) | score_variant(options, path, folder, variant, rng)
    return line | {"seconds": time.perf_counter() - begin}


def failed_scene(options: EvaluateOptions, item: tuple[int, Variant], failure: Failure) -> Line:
    """Return the line of a run that failed: it has a reason and no errors of the camera."""
    return _line_start(options, item) | {"reason": failure.reason, "seconds": failure.seconds}


def _line_start(options: EvaluateOptions, item: tuple[int, Variant]) -> Line:
    scene, variant = item
    return {"key": _key(scene, variant), "scene": scene, "variant": variant, "seed": options.seed}


def ensure_sequence(options: EvaluateOptions, folder: Path, scene: int) -> Path:
    """Return the folder of the scene's sequence, rendering it if no process has."""
    from app.slam.sequences import is_complete, write_sequence
    from sim_assets.datasets.sequences import SequenceConfig, TableSequence

    path = folder / "sequences" / f"scene_{scene}"
    if is_complete(path):
        return path
    config = SequenceConfig(frames=options.frames, depth_noise=options.depth_noise)
    partial_path = path.with_name(f".{path.name}.{os.getpid()}")
    write_sequence(partial_path, TableSequence(np.random.SeedSequence([options.seed, scene]), config))
    try:
        partial_path.rename(path)
    except OSError:  # another process was faster
        shutil.rmtree(partial_path)
    return path


@dataclass(frozen=True)
class _FinishedRun:
    """A run that is scored.

    Attributes:
        slam_run: The run.
        variant: Its variant.
        history: First states of each landmark, one for each update of its shape, by id.
        trajectory: True trajectory.
        truth: True objects.
    """

    slam_run: SlamRun
    variant: Variant
    history: Mapping[int, list[Landmark]]
    trajectory: Trajectory
    truth: TrueObjects


def score_variant(
    options: EvaluateOptions, path: Path, folder: Path, variant: Variant, rng: np.random.Generator
) -> Line:
    """Run a variant on a sequence and score it."""
    networks, sequence = networks_on(options.device), open_sequence(path)
    config = replace(variant_config(variant), concurrent=False)  # processor time of a thread has no stage
    slam_run = SlamRun.start(sequence, networks.decoder, networks.detector, config, time.process_time)
    history: dict[int, list[Landmark]] = {}
    resident = []
    for _ in slam_run.steps():
        if len(slam_run.results) % _RESIDENT_EVERY == 0:
            resident.append(resident_memory())
        if slam_run.slam.world is not None:
            for id, landmark in slam_run.slam.world.landmarks.items():
                states = history.setdefault(id, [])
                if len(states) < CURVE_UPDATES and (not states or states[-1].n_updates != landmark.n_updates):
                    states.append(landmark)
    true_trajectory = read_true_trajectory(path)
    assert true_trajectory is not None
    truth = TrueObjects(read_true_objects(path), rng)
    finished = _FinishedRun(slam_run, variant, history, true_trajectory, truth)
    line = _scores(finished, networks.decoder, rng)
    title = f"{path.name.replace('_', ' ')}, {variant}: APE {100 * line['ape_mean']:.2f} cm"
    _draw(finished, networks.decoder, folder / "pictures" / f"{path.name}_{variant}.png", title)
    return line | {"resident": resident}


def _scores(finished: _FinishedRun, decoder: Decoder, rng: np.random.Generator) -> Line:
    """Return the scores of a run; of some variants also curves of the reconstruction over updates."""
    slam_run, truth = finished.slam_run, finished.truth
    world = slam_run.slam.world
    assert world is not None
    landmarks = [world.landmarks[id] for id in world.ids]
    line: Line = absolute_pose_error(slam_run.trajectory, finished.trajectory)
    line |= {
        "reason": "done",
        "n_frames": len(slam_run.results),
        "n_lost": sum(result.status == "lost" for result in slam_run.results),
        "n_keyframes": len(slam_run.slam.keyframes),
        "n_detected": sum(result.is_detected for result in slam_run.results),
        "n_true": len(truth.categories),
        "objects": surface_rows(landmarks, truth, decoder, rng),
        "tracking_rate": slam_run.frame_rate,
        "loop_rate": slam_run.loop_rate,
        "stage_seconds": {stage: float(np.median(slam_run.seconds(stage) or [0.0])) for stage in STAGES},
        "stage_sums": {stage: float(sum(slam_run.seconds(stage))) for stage in STAGES},
    }
    if finished.variant in CURVES_OF:
        kept = {id: states for id, states in finished.history.items() if id in world.landmarks}
        line["completion_by_update"] = completion_by_update(kept, truth, decoder, rng)
    if finished.variant == CURVES_OF[0]:
        given = noisy_truth(slam_run, finished.trajectory.Ts_world_camera, rng)
        line["tsdf"] = fused_by_update(slam_run, given, truth, world.plane, rng)
    return line


def _draw(finished: _FinishedRun, decoder: Decoder, path: Path, title: str) -> None:
    """Write the picture of a run's final map."""
    slam_run = finished.slam_run
    world = slam_run.slam.world
    assert world is not None
    objects = object_estimates(world, decoder)
    mapped = MappedSequence(objects, slam_run.trajectory, slam_run.slam.keyframes, finished.trajectory)
    write_map_picture(path, mapped, title)


def noisy_truth(slam_run: SlamRun, Ts: np.ndarray, rng: np.random.Generator) -> dict[int, np.ndarray]:
    """Return true keyframe poses with the paper's noise of 1 mm and 0.1 degrees, by frame number."""
    from sim_assets.datasets.sequences import perturbed_poses

    noisy = perturbed_poses(Ts, rng)
    return {k.number: noisy[k.number] for k in slam_run.slam.keyframes}


def _format(options: EvaluateOptions) -> LedgerFormat:
    def check(line: Line) -> None:
        if line["key"] != _key(line["scene"], line["variant"]) or line["seed"] != options.seed:
            raise ValueError(f"not a run of seed {options.seed}")
        if not isinstance(line["reason"], str) or (line["reason"] == "done" and "ape_mean" not in line):
            raise ValueError("no result")
        summarise_slam([line])

    return LedgerFormat("evaluate-slam", ROWS, "key", check)


def _settings(options: EvaluateOptions) -> dict[str, Any]:
    """Return the settings that a resumed evaluation must share."""
    names = ("seed", "frames", "depth_noise", "device")
    return {name: str(getattr(options, name)) for name in names}


def _report(
    options: EvaluateOptions,
    items: Sequence[tuple[int, Variant]],
    lines: Mapping[Hashable, Line],
    seconds: float,
) -> Report:
    done = [lines[_key(*item)] for item in items if _key(*item) in lines]
    crashed = [line["key"] for line in done if "ape_mean" not in line]
    return Report(
        command="evaluate slam",
        seed=options.seed,
        success=len(done) == len(items) and not crashed,
        reason=f"{len(done)} of {len(items)} runs" + (f", {len(crashed)} crashed" if crashed else ""),
        timings={"total": seconds},
        metrics=summarise_slam(done),
        settings=_settings(options) | {"scenes": options.scenes, "variants": list(options.variants)},
    )
