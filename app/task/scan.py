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
from app.task.restricted_robot import restricted
from manipulation.kinematics import Kinematics
from manipulation.viewpoints import ViewpointScanner
from manipulation.workspace import Workspace
from perception.io.scan_folder import write_scan
from perception.types import RgbdFrame

if TYPE_CHECKING:
    from sim_assets.cell.world import World


@contextmanager
def _video(options: ScanOptions, folder: RunFolder, world: World) -> Iterator[Callable[[RgbdFrame], None]]:
    """Record a video if requested; yield the callback for each image of the wrist camera."""
    if not options.video:
        yield lambda frame: None
        return
    from app.task.video import RunVideo

    video = RunVideo(folder.path / "video.mp4", "Scan", world)
    video.begin_stage("scan")
    world.observe(lambda _: video.sample())
    try:
        yield video.on_image
    finally:
        world.observe(None)
        video.close()


def run(options: ScanOptions, screen: Screen) -> Report:
    """Take images at the scripted viewpoints and store them with their camera poses."""
    begin = time.perf_counter()
    with screen.stage("Building the cell"):
        world = build_world(options, "pack")
    with world:
        folder = RunFolder.create(options, "scan")
        started = time.perf_counter()
        with screen.stage("Scanning the table"), _video(options, folder, world) as on_image:
            space = Workspace(world.config.scale)
            kinematics, volumes = Kinematics(world.arm), space.keep_out
            scanner = ViewpointScanner(
                restricted(world), kinematics, keep_out=volumes, via_heights=space.via_heights
            )
            frames = scanner.capture(
                space.scan_viewpoints(), lambda done, total: screen.update(f"{done} of {total}"), on_image
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
