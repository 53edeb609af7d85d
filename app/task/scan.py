"""``nodeslam scan``: move the wrist camera around the table and write a scan folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.markup import escape

from app.options import ScanOptions
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from app.task.cell import build_world
from manipulation.kinematics import Kinematics
from manipulation.viewpoints import SCAN_VIEWS, look
from perception.io.scan_folder import write_scan
from perception.types import RgbdFrame

if TYPE_CHECKING:
    from sim_assets.cell.world import World


@contextmanager
def _filmed(options: ScanOptions, folder: RunFolder, world: World) -> Iterator[Callable[[RgbdFrame], None]]:
    """Films the motion where asked for; gives whom to tell of each image."""
    if not options.video:
        yield lambda frame: None
        return
    from app.task.video import Film

    film = Film(folder.path / "video.mp4", "Scan", world)
    film.begin("scan")
    world.observe(lambda _: film.sample())
    try:
        yield film.looked
    finally:
        world.observe(None)
        film.close()


def run(options: ScanOptions, screen: Screen) -> Report:
    """Take the scripted views and store them with their camera poses."""
    folder = RunFolder.create(options, "scan")
    begin = time.perf_counter()
    with screen.stage("Building the cell"):
        world = build_world(options, "pack")
    with world:
        started = time.perf_counter()
        with screen.stage("Looking at the table"), _filmed(options, folder, world) as looked:
            frames = look(
                world,
                Kinematics(world.arm),
                SCAN_VIEWS,
                lambda done, total: screen.update(f"{done} of {total}"),
                on_frame=looked,
            )
        seconds = time.perf_counter() - started
        write_scan(folder.scan, frames)
    report = Report(
        command="scan",
        seed=options.seed,
        success=True,
        reason=f"{len(frames)} images",
        timings={"scan": seconds, "total": time.perf_counter() - begin},
        metrics={"n_images": len(frames), "scan": str(folder.scan)},
    )
    folder.write_report(report)
    screen.show(escape(f"{len(frames)} images in {folder.scan}"))
    return report
