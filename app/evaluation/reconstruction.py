"""``nodeslam evaluate reconstruction``: Table 1 of the paper for the methods of this project.

Each object stands alone on a table and is imaged from random viewpoints. The protocol is the paper's: known
class, initial pose from the first view, 30 iterations, 1, 2 and 3 views, 20,000 samples on each surface,
medians. The masks come from the detector: what rises above the support plane in the noisy depth. Each
finished object is one line of ``rows.jsonl``.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from app.errors import UsageError
from app.evaluation.ledger import Ledger, LedgerFormat, Line
from app.evaluation.reconstruction_object import MOST_SUBJECTS, Subject, evaluate_subject
from app.evaluation.reconstruction_summary import reconstruction_tables, summarise_reconstruction
from app.jobs import Failure, Jobs, run_jobs
from app.options import EvaluateOptions
from app.runs.report import Report
from app.screen import Screen
from app.task.cell import parse_objects
from perception.inference.resting import ALTERNATIVES
from perception.threads import single_threaded
from perception.types import CATEGORIES, Category

ROWS = "rows.jsonl"
MOST_OBJECTS = MOST_SUBJECTS
MOST_VIEWS = 20
FOLLOWED = 6  # number of objects in the convergence plot


def run(options: EvaluateOptions, screen: Screen) -> Report:
    """Reconstruct the objects that are not finished, and report on all."""
    begin = time.perf_counter()
    check(options)
    subjects = choose_subjects(options)
    ledger, finished = Ledger.open(options, _format(options), _settings(options))
    to_do = [subject for subject in subjects if subject.name not in finished]
    if finished:
        screen.note(f"{len(subjects) - len(to_do)} of {len(subjects)} objects are finished already")
    jobs = Jobs(to_do, partial(evaluate_subject, options), partial(failed_subject, options))
    with screen.stage(f"Reconstructing {len(to_do)} objects by {len(options.methods)} methods"):
        for line in run_jobs(jobs, options):
            finished[line["object"]] = line
            ledger.append(line)
            screen.update(f"{len(finished)} of {len(subjects)}: {line['object']}")
            ledger.folder.write_report(_report(options, subjects, finished, time.perf_counter() - begin))
    report = _report(options, subjects, finished, time.perf_counter() - begin)
    ledger.folder.write_report(report)
    with screen.stage("Drawing plots and pictures"), single_threaded():  # the same results as the rows
        from app.evaluation.reconstruction_pictures import write_pictures

        by_name = {subject.name: subject for subject in subjects}
        write_pictures(ledger.folder.path, report, by_name, options)
    for table in reconstruction_tables(report):
        screen.show(table)
    screen.show(f"plots and pictures in {ledger.folder.path}")
    return report


def failed_subject(options: EvaluateOptions, subject: Subject, failure: Failure) -> Line:
    """Return the line of an object whose evaluation failed: no method found it."""
    rows = [
        {
            "object": subject.name,
            "category": subject.category,
            "resting": subject.resting,
            "views": views,
            "method": method,
            "found": False,
            "seconds": round(failure.seconds, 3),
            "reason": failure.reason,
        }
        for views in options.views
        for method in options.methods
    ]
    return {"object": subject.name, "rows": rows, "failed": failure.reason}


def check(options: EvaluateOptions) -> None:
    """Validate the options.

    Raises:
        UsageError: An option is invalid.
        FusionUnavailableError: TSDF fusion without open3d.
    """
    if not options.views or min(options.views) < 1 or max(options.views) > MOST_VIEWS:
        raise UsageError(f"--views takes numbers from 1 to {MOST_VIEWS}")
    if not options.methods:
        raise UsageError("--methods needs at least one method")
    if not options.poses:
        raise UsageError("--poses needs at least one resting pose")
    if set(options.poses) != {"upright"} and "full" not in options.methods:
        raise UsageError("--poses compares resting poses by the method full: add it to --methods")
    named = {"views": options.views, "methods": options.methods, "poses": options.poses}
    for name, values in named.items():
        if len(set(values)) < len(values):
            raise UsageError(f"--{name} names one twice")
    if options.object_meshes is not None and not options.object_meshes.is_dir():
        raise UsageError(
            f"--object-meshes {options.object_meshes} is no folder; give DIR of DIR/<class>/*.ply"
        )
    if "tsdf" in options.methods:
        from perception.fusion.tsdf import load_open3d

        load_open3d()


def choose_subjects(options: EvaluateOptions) -> list[Subject]:
    """Return the objects: ``--objects`` of the test families, or every mesh of ``--object-meshes``."""
    if options.object_meshes is None:
        wanted = Counter(parse_objects(options.objects, np.random.default_rng(options.seed), MOST_OBJECTS))
        numbered: list[tuple[Category, int, Path | None]] = [
            (c, index, None) for c in CATEGORIES for index in range(wanted[c])
        ]
    else:
        from sim_assets.objects.user import mesh_files

        numbers: Counter[Category] = Counter()
        numbered = []
        for path, category in mesh_files(options.object_meshes):
            numbered.append((category, numbers[category], path))
            numbers[category] += 1
    upright_only = set(options.poses) == {"upright"}
    return [
        Subject(category, index, path, upright_only and n < FOLLOWED, pose)
        for pose in options.poses
        for n, (category, index, path) in enumerate(numbered)
        if pose == "upright" or pose in ALTERNATIVES[category]
    ]


def _format(options: EvaluateOptions) -> LedgerFormat:
    expected = {(views, method) for views in options.views for method in options.methods}

    def check_line(line: Line) -> None:
        if {(row["views"], row["method"]) for row in line["rows"]} != expected:
            raise ValueError("not the rows of --views and --methods")
        summarise_reconstruction([line])

    return LedgerFormat("evaluate-reconstruction", ROWS, "object", check_line)


def _settings(options: EvaluateOptions) -> dict[str, Any]:
    """Return the settings that must agree in a resumed evaluation."""
    objects = ("objects", "object_meshes", "poses", "depth_noise")
    names = ("seed", *objects, "views", "methods", "masks", "device")
    return {name: str(getattr(options, name)) for name in names}


def _report(
    options: EvaluateOptions, subjects: Sequence[Subject], lines: Mapping[Hashable, Line], seconds: float
) -> Report:
    done = [lines[subject.name] for subject in subjects if subject.name in lines]
    failed = [line for line in done if "failed" in line]
    return Report(
        command="evaluate reconstruction",
        seed=options.seed,
        success=len(done) == len(subjects) and not failed,
        reason=f"{len(done)} of {len(subjects)} objects" + (f", {len(failed)} failed" if failed else ""),
        timings={"total": seconds},
        metrics=summarise_reconstruction(done),
        settings=_settings(options),
    )
