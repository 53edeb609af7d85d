"""``nodeslam bench --growth``: how times grow with objects, views, landmarks and workers, as curves.

Each point is the processor time and the wall time of one call, medians of ``--repeats`` calls.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from statistics import median
from typing import Any

from rich.table import Table

from app.benchmarks.growth_planning import PlanningTimes, planning_times
from app.benchmarks.growth_plot import svg_of
from app.benchmarks.growth_scene import (
    MAX_VIEWS,
    enlarge_map,
    n_masks,
    plane_of_table,
    sequence,
    table_views,
)
from app.benchmarks.machine import describe_machine
from app.benchmarks.scene import as_captured
from app.benchmarks.timing import Job, clocked
from app.evaluation.tasks import failed_seed, run_seed
from app.jobs import Jobs, run_jobs
from app.options import BenchOptions, EvaluateOptions
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.inference.acceptance import shipped_acceptance
from perception.inference.reconstruct import ReconstructOptions, reconstruct
from perception.io.files import write_atomically
from perception.pipeline import Detections, Perception, detect, load_perception, resolve_device
from perception.slam.config import SlamConfig
from perception.slam.system import Slam
from perception.threads import single_threaded
from perception.types import RgbdFrame

OBJECTS = (1, 2, 5, 10, 20)
PACKED = (2, 4, 6, 8, 10, 12)
VIEWS = (1, 2, 5, 10, 20)
LANDMARKS = (1, 3, 10, 30, 100)
_OBJECTS_OF_VIEWS, _VIEWS_OF_OBJECTS = 6, 5
_MAX_IN_VIEW = 10  # landmarks; a larger map has the others out of view
_FRAMES = 20  # of a sequence
_STAGES = {"track": "track one frame", "joint": "joint optimisation"}
_EPISODES = 4  # per point of the workers' curve


@dataclass(frozen=True)
class Point:
    """One point of a curve.

    Attributes:
        at: Value of the parameter.
        seconds: Median wall time, in seconds; None where it is not measured.
        core_seconds: Median processor time of all threads, in seconds; None where other processes work.
    """

    at: int
    seconds: float | None
    core_seconds: float | None


@dataclass(frozen=True)
class Curve:
    """Times of one job over one parameter.

    Attributes:
        name: Description of the job.
        parameter: What grows.
        points: Times in ascending order of the parameter.
    """

    name: str
    parameter: str
    points: tuple[Point, ...]


def run(options: BenchOptions, screen: Screen) -> Report:
    """Measure every curve; the report is written after each."""
    begin = time.perf_counter()
    machine = describe_machine(resolve_device(options.device))
    folder = RunFolder.create(options, "bench")
    curves: list[Curve] = []
    report = _report(options, machine, curves, 0.0, done=False)
    with screen.stage("Measuring growth"), single_threaded():
        networks = load_perception(options.device)
        for curve in _curves(networks, options):
            screen.update(curve.name)
            curves.append(curve)
            report = _report(options, machine, curves, time.perf_counter() - begin, done=False)
            folder.write_report(report)
    report = replace(report, success=True, reason=f"{len(curves)} curves")
    folder.write_report(report)
    write_atomically(folder.path / "growth.svg", svg_of(report.metrics["curves"]))
    screen.show(_table(curves))
    return report


def _curves(networks: Perception, options: BenchOptions) -> Iterator[Curve]:
    repeats, seed = options.repeats, options.seed
    yield from _over_objects(networks, repeats, seed)
    yield from _over_packed(networks, seed)
    yield from _over_views(networks, repeats, seed)
    yield from _over_landmarks(networks, seed)
    if options.growth_workers:
        yield _over_workers(options)


def _over_objects(networks: Perception, repeats: int, seed: int) -> Iterator[Curve]:
    found, fitted = [], []
    for n in OBJECTS:
        scene = table_views(n, _VIEWS_OF_OBJECTS, seed)
        frame = scene.frames[:1]
        if not found:  # compiled kernels are loaded by the first call
            detect(frame, networks.detector)
            _reconstruction(networks, scene)()
        found.append(_point(n, repeats, lambda frame=frame: _detect(frame, networks)))
        fitted.append(_point(n_masks(scene.masks), repeats, _reconstruction(networks, scene)))
    yield Curve("detect the objects of one image", "objects", tuple(found))
    yield Curve(f"reconstruct from {_VIEWS_OF_OBJECTS} views", "objects", tuple(fitted))


def _over_packed(networks: Perception, seed: int) -> Iterator[Curve]:
    """Time planning: of the layout, and of the motions of each object, median and largest."""
    times = {n: planning_times(networks, n, seed) for n in PACKED}
    curves: dict[str, Callable[[PlanningTimes], float]] = {
        "lay out a packing task": lambda t: t.layout,
        "plan the motions of one object": lambda t: median(t.objects),
        "plan the motions of the slowest object": lambda t: max(t.objects),
    }
    for name, of in curves.items():
        yield Curve(name, "objects", tuple(Point(n, None, of(t)) for n, t in times.items()))


def _over_views(networks: Perception, repeats: int, seed: int) -> Iterator[Curve]:
    scene = table_views(_OBJECTS_OF_VIEWS, MAX_VIEWS, seed)
    found, fitted = [], []
    for n in VIEWS:
        views = scene.spread(n)
        frames = views.frames
        found.append(_point(n, repeats, lambda frames=frames: _detect(frames, networks)))
        fitted.append(_point(n, repeats, _reconstruction(networks, views)))
    yield Curve("detect", "views", tuple(found))
    yield Curve(f"reconstruct {_OBJECTS_OF_VIEWS} objects", "views", tuple(fitted))


def _reconstruction(networks: Perception, scene: Any) -> Job:
    fit = ReconstructOptions(workers=1, acceptance=shipped_acceptance())
    plane = plane_of_table()
    return lambda: reconstruct(
        as_captured(scene.frames), scene.masks, networks.decoder, (plane,), options=fit
    )


def _detect(frames: Sequence[RgbdFrame], networks: Perception) -> Detections:
    return detect(as_captured(frames), networks.detector, workers=1)


def _over_landmarks(networks: Perception, seed: int) -> Iterator[Curve]:
    """Time the stages of SLAM that depend on the map."""
    points: dict[str, list[Point]] = {stage: [] for stage in _STAGES}
    for n in LANDMARKS:
        for stage, seconds in _stage_times(networks, n, seed).items():
            points[stage].append(Point(n, None, median(seconds)))
    for stage, name in _STAGES.items():
        yield Curve(name, "landmarks", tuple(points[stage]))


def _stage_times(networks: Perception, size: int, seed: int) -> dict[str, list[float]]:
    """Return the processor times of the stages in the tracked frames of a sequence, with a map of a size.

    The first frame initialises the map, which is then enlarged; the second includes the consequences.
    """
    slam = Slam(networks.decoder, networks.detector, SlamConfig(concurrent=False), time.process_time)
    first, *frames = sequence(min(size, _MAX_IN_VIEW), _FRAMES, seed)
    slam.process(first)
    if slam.world is not None and slam.world.ids:
        enlarge_map(slam, size)
    results = [slam.process(frame) for frame in frames][1:]
    tracked = [result.seconds for result in results if result.status != "lost"]
    times = {stage: [seconds[stage] for seconds in tracked if stage in seconds] for stage in _STAGES}
    return {stage: seconds for stage, seconds in times.items() if seconds}


def _over_workers(options: BenchOptions) -> Curve:
    """Time episodes of the oracle packing a can, which cost the same in every process."""
    points = []
    for workers in options.growth_workers:
        episodes = EvaluateOptions(
            what="tasks",
            objects="can=1",
            shapes=("oracle",),
            episodes=_EPISODES,
            workers=workers,
            seed=options.seed,
        )
        jobs = Jobs(
            range(options.seed, options.seed + _EPISODES),
            partial(run_seed, episodes),
            partial(failed_seed, episodes),
        )
        wall, _ = clocked(lambda jobs=jobs, episodes=episodes: list(run_jobs(jobs, episodes)))
        points.append(Point(workers, wall / _EPISODES, None))
    return Curve("packing episode, one object", "workers", tuple(points))


def _point(at: int, repeats: int, job: Job) -> Point:
    wall, core = zip(*(clocked(job) for _ in range(repeats)))
    return Point(at, median(wall), median(core))


def _report(
    options: BenchOptions, machine: dict[str, Any], curves: Sequence[Curve], seconds: float, done: bool
) -> Report:
    return Report(
        command="bench",
        seed=options.seed,
        success=done,
        reason=f"{len(curves)} curves, not all",
        timings={"total": seconds},
        metrics={"curves": [asdict(curve) for curve in curves], "machine": machine},
        settings={"growth": True, "repeats": options.repeats},
    )


def _table(curves: Sequence[Curve]) -> Table:
    table = Table(title="nodeslam bench --growth: median times", title_justify="left", show_edge=False)
    for heading in ("", "over", "at", "time", "on cores"):
        table.add_column(heading, justify="left" if heading in ("", "over") else "right")
    for curve in curves:
        for k, point in enumerate(curve.points):
            name, over = (curve.name, curve.parameter) if k == 0 else ("", "")
            times = ("" if t is None else f"{1e3 * t:.0f} ms" for t in (point.seconds, point.core_seconds))
            table.add_row(name, over, str(point.at), *times)
    return table
