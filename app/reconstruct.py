"""``nodeslam reconstruct SCAN``: objects of a scan folder; independent of the simulator."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from rich.markup import escape
from rich.table import Table

from app.drawing import draw_detections, draw_estimates, draw_rejected
from app.options import ReconstructOptions
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.detection.association import associate
from perception.io.files import write_atomically
from perception.io.images import png_bytes
from perception.io.object_map import write_object_map
from perception.io.scan_folder import Scan, read_scan, write_scan
from perception.pipeline import (
    SHIPPED,
    Detections,
    load_decoder,
    load_detector,
    load_huggingface,
    reconstruct_objects,
)
from perception.pipeline import detect as detect_objects
from perception.scans import completed, scan_detections, scan_plane, usable_part
from perception.types import ObjectEstimate, RejectedObject, RgbdFrame, SupportPlane


def run(options: ReconstructOptions, screen: Screen) -> Report:
    """Detect objects unless the folder has detections or masks, reconstruct them, write the object map."""
    begin = time.perf_counter()
    timings: dict[str, float] = {}
    recorded = read_scan(options.scan)
    plane, scan = scan_plane(recorded), usable_part(recorded)
    folder = RunFolder.create(options, "reconstruct")
    for warning in scan.warnings:
        screen.note(f"left out: {warning}")
    with screen.stage("Loading networks"):
        decoder = load_decoder(options.device)
    started = time.perf_counter()
    with screen.stage("Finding objects"):
        detections = _detections(scan, plane, options)
    timings["detect"] = time.perf_counter() - started
    started = time.perf_counter()
    rejected: list[RejectedObject] = []
    with screen.stage("Reconstructing whole shapes"):
        objects = reconstruct_objects(
            scan.frames,
            detections,
            decoder,
            lambda done, total, item="": screen.update(f"{done} of {total}"),
            on_rejected=rejected.append,
        )
    timings["reconstruct"] = time.perf_counter() - started
    write_scan(folder.scan, scan.frames, detections.per_frame)
    unwritten = write_object_map(folder.path, objects)
    rejected += unwritten
    objects = [o for o in objects if o.id not in {item.id for item in unwritten}]
    _write_pictures(folder, scan.frames, detections, objects, rejected)
    report = Report(
        command="reconstruct",
        seed=options.seed,
        success=bool(objects),
        reason=_summary(objects, rejected),
        timings=timings | {"total": time.perf_counter() - begin},
        objects=[ObjectReport(o.id, o.category, details=_details(o)) for o in objects],
        metrics={
            "n_images": len(scan.frames),
            "n_objects": len(objects),
            "left_out": [asdict(item) for item in rejected],
        },
        warnings=[*scan.warnings, *(f"{item.name} is left out: {item.reason}" for item in rejected)],
        settings={"scan": str(options.scan)},
    )
    folder.write_report(report)
    screen.show(_table(objects))
    screen.show(escape(f"meshes in {folder.path / 'objects'}, the list in objects.json"))
    return report


def _detections(scan: Scan, plane: SupportPlane, options: ReconstructOptions) -> Detections:
    """Return the folder's detections or classified masks where it has them, else those of the detector."""
    own = scan_detections(scan, plane, lambda: load_detector(options.device), options.scan)
    if own is not None:
        return own
    if options.detector == SHIPPED:
        return detect_objects(scan.frames, load_detector(options.device), plane=plane)
    model = load_huggingface(options.detector, options.device)
    found = [model(frame) for frame in scan.frames]
    found = completed(scan.frames, found, (plane,), lambda: load_detector(options.device))
    return Detections(plane, tuple(map(tuple, associate(scan.frames, found, plane))))


def _summary(objects: Sequence[ObjectEstimate], rejected: Sequence[RejectedObject]) -> str:
    """Return the outcome in one line: number of objects, those left out and why."""
    left_out = "; ".join(f"{item.name} is left out: {item.reason}" for item in rejected)
    if objects:
        return f"{len(objects)} objects" + (f"; {left_out}" if left_out else "")
    return f"no object was reconstructed: {left_out}" if left_out else "no object was found in the scan"


def _write_pictures(
    folder: RunFolder,
    frames: tuple[RgbdFrame, ...],
    detections: Detections,
    objects: Sequence[ObjectEstimate],
    rejected: Sequence[RejectedObject],
) -> None:
    """Write ``overview.png``: up to three images with detections above and reconstructions below.

    Objects that are left out are outlined in the lower images, with the reason.
    """
    chosen = sorted({0, len(frames) // 2, len(frames) - 1})
    found = np.concatenate([draw_detections(frames[i], detections.per_frame[i]) for i in chosen], axis=1)
    whole = np.concatenate(
        [
            draw_rejected(draw_estimates(frames[i], objects), detections.per_frame[i], rejected)
            for i in chosen
        ],
        axis=1,
    )
    write_atomically(folder.path / "overview.png", png_bytes(np.concatenate([found, whole])))


def _details(estimate: ObjectEstimate) -> dict[str, float | str | int]:
    return {
        "height": estimate.height,
        "radius": estimate.radius,
        "score": float(estimate.score),
        "n_views": estimate.n_views,
        "residual": float(estimate.residual),
        "status": estimate.status,
    }


def _table(objects: list[ObjectEstimate]) -> Table:
    table = Table(title=f"{len(objects)} objects", title_justify="left", show_edge=False, pad_edge=False)
    for heading in ("object", "at (x, y)", "height", "radius", "views", "residual", "fit"):
        table.add_column(heading, justify="left" if heading in ("object", "fit") else "right")
    for o in objects:
        x, y = o.T_world_object[:2, 3]
        size = (f"{1000 * o.height:.0f} mm", f"{1000 * o.radius:.0f} mm", str(o.n_views))
        residual = f"{1000 * o.residual:.1f} mm"
        table.add_row(o.name, f"{x:.3f}, {y:.3f} m", *size, residual, o.status.replace("_", " "))
    return table
