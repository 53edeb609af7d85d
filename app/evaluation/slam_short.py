"""``nodeslam evaluate slam --short-runs N``: short sequences, of which only the scores are kept.

Every second sequence is close up, with two or three objects in view. Scored are undetected drift of the
camera, spurious and misplaced landmarks of the final map, and relocalisation of single frames in it.
``--faults`` are applied to the runs in turn. Each run is one line of ``short.jsonl``.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from rich.table import Table

from app.errors import UsageError
from app.evaluation.ledger import Ledger, LedgerFormat, Line
from app.evaluation.slam_faults import MOVED_AT, flickering, with_fault
from app.evaluation.slam_scoring import TrueObjects, absolute_pose_error, places_of, surface_rows
from app.evaluation.slam_summary import NAMES
from app.evaluation.statistics import paired_difference, wilson_interval
from app.jobs import Failure, Jobs, networks_on, run_jobs
from app.options import EvaluateOptions, SlamFault
from app.runs.report import Report
from app.screen import Screen
from app.slam.run import SlamRun
from perception.geometry import transform_points
from perception.inference.shape_model import Decoder
from perception.io.recordings.sequence import RgbdSequence
from perception.io.recordings.trajectory import Trajectory
from perception.slam.ablations import variant_config
from perception.slam.frame_detections import Detect
from perception.types import ObjectDetection, RgbdFrame, SupportPlane, TriangleMesh

ROWS = "short.jsonl"
DRIFT = 0.03  # [m] position error above which a frame that is not lost counts as drift
FOUND = 0.03  # [m] position error below which a frame counts as relocalised
_SEEDS_FROM = 1000  # smaller numbers are scenes of the full evaluation
_IN_VIEW = 300  # pixels above which an object counts as in view
_TRY_EVERY = 10  # frames between those that are relocalised in the final map
_TRY_OBJECTS = 4  # least number in view of a frame that is relocalised


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Run the unfinished sequences and report on all."""
    begin = time.perf_counter()
    if options.short_runs < 1 or options.frames < 10 or not options.variants or not options.faults:
        raise UsageError(
            "evaluate slam --short-runs needs a run, ten frames, a variant and a fault (or none)"
        )
    names = ("seed", "frames", "depth_noise", "device", "variants", "faults")
    settings = {name: str(getattr(options, name)) for name in names}
    ledger, finished = Ledger.open(options, _format(options), settings)
    to_do = [index for index in range(options.short_runs) if index not in finished]
    to_do.sort(key=lambda index: (index % 2 == 0, index))  # close-ups are the harder ones
    if finished:
        screen.note(f"{options.short_runs - len(to_do)} of {options.short_runs} runs are already finished")
    jobs = Jobs(to_do, partial(run_short, options), partial(failed_run, options))
    with screen.stage(f"{len(to_do)} short runs"):
        for line in run_jobs(jobs, options):
            finished[line["key"]] = line
            ledger.append(line)
            ledger.folder.write_report(_report(options, settings, finished, time.perf_counter() - begin))
            screen.update(f"{len(finished)} of {options.short_runs}")
            if line["reason"] != "done" or any(entry["drifted"] for entry in line["variants"].values()):
                screen.note(f"run {line['key']}, {line['fault']}: {line['reason']} {_brief(line)}")
    report = _report(options, settings, finished, time.perf_counter() - begin)
    ledger.folder.write_report(report)
    screen.show(short_table(report))
    return report


def _brief(line: Mapping[str, Any]) -> str:
    worst = {name: f"{100 * entry['drift']:.1f} cm" for name, entry in line.get("variants", {}).items()}
    return ", ".join(f"{name} off by up to {value}" for name, value in worst.items())


def run_short(options: EvaluateOptions, index: int) -> Line:
    """Evaluate all variants on one short sequence."""
    line, begin = _line_start(options, index), time.perf_counter()
    line |= _run_variants(options, index, line["close_up"], line["fault"]) | {"reason": "done"}
    return line | {"seconds": time.perf_counter() - begin}


def failed_run(options: EvaluateOptions, index: int, failure: Failure) -> Line:
    """Return the line of a run that failed: it has a reason and no variants."""
    return _line_start(options, index) | {"reason": failure.reason, "seconds": failure.seconds}


def _line_start(options: EvaluateOptions, index: int) -> Line:
    fault = options.faults[index // 2 % len(options.faults)]
    return {"key": index, "seed": options.seed, "close_up": index % 2 == 1, "fault": fault}


def _format(options: EvaluateOptions) -> LedgerFormat:
    def check(line: Line) -> None:
        start = _line_start(options, line["key"])
        if any(line[name] != value for name, value in start.items()):
            raise ValueError(f"not a run of seed {options.seed} and these --faults")
        if not isinstance(line["reason"], str):
            raise ValueError("no reason")
        if line["reason"] == "done" and set(line["variants"]) != set(options.variants):
            raise ValueError("not the results of --variants")
        summarise_short([line])

    return LedgerFormat("evaluate-slam-short", ROWS, "key", check)


def _run_variants(options: EvaluateOptions, index: int, close_up: bool, fault: SlamFault) -> dict[str, Any]:
    from sim_assets.datasets.sequences import CLOSE_UP, SequenceConfig, TableSequence

    config = replace(
        CLOSE_UP if close_up else SequenceConfig(),
        frames=options.frames,
        depth_noise=options.depth_noise,
        moved_at=int(MOVED_AT * options.frames) if fault == "moved" else None,
    )
    root = np.random.SeedSequence([options.seed, _SEEDS_FROM + index])
    table = TableSequence(root, config)
    images = list(table.render())
    in_view = [int((np.bincount(i.instances[i.instances >= 0]) >= _IN_VIEW).sum()) for i in images]
    frames = [image.frame for image in images]
    rng = np.random.default_rng([options.seed, _SEEDS_FROM + index])
    sequence = with_fault(frames, fault, rng)
    surfaces = [
        (
            o.model.category,
            TriangleMesh(transform_points(o.T_world_object, o.model.mesh.vertices), o.model.mesh.faces),
        )
        for o in table.objects
    ]
    objects = TrueObjects(surfaces, np.random.default_rng([options.seed, index]))
    truth = Trajectory.of([frame.time for frame in frames], list(table.Ts_world_camera))
    entries = {}
    for variant in options.variants:
        networks = networks_on(options.device)
        detect = networks.detector
        if fault == "flicker":
            detect = partial(_flickering, networks.detector, rng)
        slam_run = SlamRun.start(
            sequence, networks.decoder, detect, replace(variant_config(variant), concurrent=False),
            time.process_time,
        )  # fmt: skip
        for _ in slam_run.steps():
            pass
        entries[variant] = (
            _drift(slam_run, truth) | _map_health(slam_run, objects, table.moved, networks.decoder)
            | _relocalisations(slam_run, sequence, frames, in_view, truth)
        )  # fmt: skip
    return {"objects_in_view": float(np.median(in_view)), "variants": entries}


def _flickering(
    detector: Detect, rng: np.random.Generator, frame: RgbdFrame, plane: SupportPlane
) -> list[ObjectDetection]:
    return flickering(detector(frame, plane), rng)


def _drift(slam_run: SlamRun, truth: Trajectory) -> dict[str, Any]:
    """Return the position errors of the frames that are not lost, and whether one exceeds ``DRIFT``."""
    lost = [result.status == "lost" for result in slam_run.results]
    entry: dict[str, Any] = absolute_pose_error(slam_run.trajectory, truth)
    entry["drift"] = entry["ape_max"]
    entry["drifted"] = bool(entry["ape_max"] > DRIFT)
    entry["n_lost"], entry["n_frames"], entry["ends_lost"] = sum(lost), len(lost), lost[-1]
    entry["n_beyond"] = _beyond(slam_run, truth)
    entry["n_weak"] = sum(result.status == "weak" for result in slam_run.results)
    return entry


def _beyond(slam_run: SlamRun, truth: Trajectory) -> int:
    """Return the number of frames, not lost, whose error exceeds two estimated standard deviations."""
    true_place = dict(zip(truth.times, truth.Ts_world_camera[:, :3, 3]))
    return sum(
        bool(
            np.linalg.norm(result.T_world_camera[:3, 3] - true_place[result.time])
            > 2 * max(result.position_std, 1e-3)
        )
        for result in slam_run.results
        if result.status != "lost"
    )


def _map_health(slam_run: SlamRun, truth: TrueObjects, moved: int | None, decoder: Decoder) -> dict[str, Any]:
    """Return numbers of spurious landmarks (duplicates included), position errors and surface accuracies.

    ``surfaces`` holds the accuracy [m] of each true object in the final map, by its index; ``moved`` is the
    index of the object that was displaced during the sequence.
    """
    world = slam_run.slam.world
    assert world is not None
    landmarks = [world.landmarks[id] for id in world.ids]
    places = places_of(landmarks)
    matches = truth.match(places)
    errors = [float(np.linalg.norm(places[id] - truth.centres[k])) for id, k in matches.items()]
    rows = surface_rows(landmarks, truth, decoder, np.random.default_rng(0))
    return {
        "n_landmarks": len(places),
        "n_phantoms": len(places) - len(matches),
        "misplaced": max(errors, default=0.0),
        "moved": moved,
        "moved_is_known": None if moved is None else moved in matches.values(),
        "surfaces": {str(row["true_index"]): row["accuracy"] for row in rows if "accuracy" in row},
    }


def _relocalisations(
    slam_run: SlamRun,
    sequence: RgbdSequence,
    frames: Sequence[RgbdFrame],
    in_view: Sequence[int],
    truth: Trajectory,
) -> dict[str, int]:
    """Relocalise frames with enough objects in view in the final map, and count successes and errors."""
    tried = succeeded = wrong = 0
    for number in sequence.ids[::_TRY_EVERY]:
        frame = sequence.read(number)
        if in_view[number] < _TRY_OBJECTS or not (frame.depth > 0).any():
            continue
        found = slam_run.relocalise(number, frame)
        tried += 1
        if found is None:
            continue
        T = found.tracked.T_world_camera
        near = np.linalg.norm(T[:3, 3] - truth.Ts_world_camera[number][:3, 3]) < FOUND
        succeeded, wrong = succeeded + bool(near), wrong + (not near)
    return {"relocalisations": tried, "relocalised": succeeded, "relocalised_wrongly": wrong}


def summarise_short(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Summarise drift, losses, maps and relocalisation of each variant over all runs; lengths in metres."""
    variants = list(dict.fromkeys(name for line in lines for name in line.get("variants", ())))
    apes = {
        name: {
            line["key"]: line["variants"][name]["ape_mean"]
            for line in lines
            if name in line.get("variants", {})
        }
        for name in variants
    }
    return {
        "rows": list(lines),
        "variants": {name: _over_runs(lines, name) for name in variants},
        "against_full": {
            name: paired_difference(apes["full"], apes[name])
            for name in variants
            if name != "full" and "full" in apes
        },
    }


def _over_runs(lines: Sequence[Mapping[str, Any]], variant: str) -> dict[str, Any]:
    runs = [line["variants"][variant] for line in lines if variant in line.get("variants", {})]
    surfaces = [accuracy for run in runs for accuracy in run["surfaces"].values()]
    tried, found = (sum(run[key] for run in runs) for key in ("relocalisations", "relocalised"))
    return {
        "n": len(runs),
        "n_failed": len(lines) - len(runs),
        "ape_mean": float(np.mean([run["ape_mean"] for run in runs])),
        "drift_max": max(run["drift"] for run in runs),
        "n_drifted": sum(run["drifted"] for run in runs),
        "n_with_loss": sum(run["n_lost"] > 0 for run in runs),
        "lost_share": sum(run["n_lost"] for run in runs) / sum(run["n_frames"] for run in runs),
        "n_beyond": sum(run["n_beyond"] for run in runs),
        "n_end_lost": sum(run["ends_lost"] for run in runs),
        "n_phantoms": sum(run["n_phantoms"] for run in runs),
        "n_moved_known": sum(bool(run["moved_is_known"]) for run in runs),
        "relocalisations": tried,
        "relocalisation_rate": found / max(tried, 1),
        "relocalisation_rate_ci": wilson_interval(found, tried),
        "relocalised_wrongly": sum(run["relocalised_wrongly"] for run in runs),
        "accuracy_median": float(np.median(surfaces or [np.nan])),
    }


def short_table(report: Report) -> Table:
    """Return a table with one row for each variant."""
    table = Table(title=report.reason, title_justify="left", show_edge=False, pad_edge=False)
    table.add_column("")
    headings = (
        "mean APE cm",
        "worst error cm",
        "drifted",
        "were lost",
        "frames lost %",
        "end lost",
        "spurious landmarks",
        "accuracy mm",
        "relocalised %",
    )
    for heading in headings:
        table.add_column(heading, justify="right")
    for name, figures in report.metrics["variants"].items():
        table.add_row(
            NAMES.get(name, name),
            f"{100 * figures['ape_mean']:.2f}",
            f"{100 * figures['drift_max']:.2f}",
            f"{figures['n_drifted']} of {figures['n']}",
            str(figures["n_with_loss"]),
            f"{100 * figures['lost_share']:.1f}",
            str(figures["n_end_lost"]),
            str(figures["n_phantoms"]),
            f"{1000 * figures['accuracy_median']:.1f}",
            f"{100 * figures['relocalisation_rate']:.1f} of {figures['relocalisations']}",
        )
    return table


def _report(
    options: EvaluateOptions, settings: Mapping[str, Any], lines: Mapping[Hashable, Line], seconds: float
) -> Report:
    done = [lines[index] for index in range(options.short_runs) if index in lines]
    crashed = [line for line in done if line["reason"] != "done"]
    drifted = sum(entry["drifted"] for line in done for entry in line.get("variants", {}).values())
    return Report(
        command="evaluate slam",
        seed=options.seed,
        success=len(done) == options.short_runs and not crashed and not drifted,
        reason=f"{len(done)} of {options.short_runs} short runs, {drifted} drifted, {len(crashed)} crashed",
        timings={"total": seconds},
        metrics=summarise_short(done),
        settings={**settings, "short_runs": options.short_runs},
    )
