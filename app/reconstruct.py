"""``nodeslam reconstruct SCAN``: objects of a scan folder; independent of the simulator."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
from rich.markup import escape
from rich.table import Table

from app.detection_summary import left_out_as_json, surface_lines, surfaces_as_json, why_nothing
from app.drawing import draw_detections, draw_estimates, draw_left_out, draw_rejected, draw_surfaces
from app.errors import UsageError
from app.options import ReconstructOptions
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.detection.left_out import summarise
from perception.inference.reconstruct import with_estimated_classes
from perception.io.bop_results import PosedImage, write_bop_results
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
    place_detections,
    reconstruct_objects,
)
from perception.pipeline import detect as detect_objects
from perception.scans import completed, scan_detections, scan_surfaces, usable_part
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, ObjectEstimate, RejectedObject, RgbdFrame


def run(options: ReconstructOptions, screen: Screen) -> Report:
    """Detect objects unless the folder has detections or masks, reconstruct them, write the object map."""
    begin = time.perf_counter()
    timings: dict[str, float] = {}
    recorded = read_scan(options.scan)
    _check_detector(options, recorded)
    surfaces, scan = scan_surfaces(recorded), usable_part(recorded)
    folder = RunFolder.create(options, "reconstruct")
    for warning in scan.warnings:
        screen.note(f"left out: {warning}")
    with screen.stage("Loading networks"):
        decoder = load_decoder(options.device)
    started = time.perf_counter()
    with screen.stage("Finding objects"):
        detections = _detections(scan, surfaces, options)
    timings["detect"] = time.perf_counter() - started
    for line in surface_lines(detections, scan.frames[0]) + summarise(detections.left_out, len(scan.frames)):
        screen.note(line)
    started = time.perf_counter()
    rejected: list[RejectedObject] = []
    with screen.stage("Reconstructing whole shapes"):
        objects = reconstruct_objects(
            scan.frames,
            detections,
            decoder,
            lambda done, total, item="": screen.update(f"{done} of {total}"),
            on_rejected=rejected.append,
            clutter=load_detector(options.device) if options.clutter else None,
        )
    timings["reconstruct"] = time.perf_counter() - started
    detections = replace(detections, per_frame=with_estimated_classes(detections.per_frame, objects))
    write_scan(folder.scan, scan.frames, detections.per_frame)
    unwritten = write_object_map(folder.path, objects)
    rejected += unwritten
    objects = [o for o in objects if o.id not in {item.id for item in unwritten}]
    seconds = timings["detect"] + timings["reconstruct"]
    write_bop_results(folder.path / "bop.csv", options.scan, objects, _posed_images(scan), seconds)
    _write_pictures(folder, scan.frames, detections, objects, rejected)
    report = Report(
        command="reconstruct",
        seed=options.seed,
        success=bool(objects),
        reason=_summary(objects, rejected) or why_nothing(detections, scan.frames),
        timings=timings | {"total": time.perf_counter() - begin},
        objects=[ObjectReport(o.id, o.category, details=_details(o)) for o in objects],
        metrics={
            "n_images": len(scan.frames),
            "n_objects": len(objects),
            "left_out": [asdict(item) for item in rejected],
            "candidates_left_out": left_out_as_json(detections.left_out),
            "surfaces": surfaces_as_json(detections.surfaces),
        },
        warnings=[
            *scan.warnings,
            *(f"{item.name} is left out: {item.reason}" for item in rejected),
            *_doubts(objects, len(rejected), len(scan.frames)),
        ],
        settings={"scan": str(options.scan), "clutter": options.clutter},
    )
    folder.write_report(report)
    if objects:
        screen.show(_table(objects))
        screen.show(escape(f"meshes in {folder.path / 'objects'}, the list in objects.json"))
    else:
        screen.show(escape(f"{report.reason} (overview.png in {folder.path} shows where)"))
    return report


def _check_detector(options: ReconstructOptions, scan: Scan) -> None:
    """Raise UsageError if another detector is asked for where the folder says what its images show."""
    own = "detections.json" if scan.detections is not None else "masks" if scan.masks is not None else ""
    if own and options.detector != SHIPPED:
        raise UsageError(
            f"--detector {options.detector}: {options.scan} has {own}, which would be used instead: omit"
            " --detector, or move them away"
        )


def _detections(scan: Scan, surfaces: Sequence[SupportSurface], options: ReconstructOptions) -> Detections:
    """Return the folder's detections or classified masks where it has them, else those of the detector."""
    own = scan_detections(scan, surfaces, lambda: load_detector(options.device), options.scan)
    if own is not None:
        return own
    if options.detector == SHIPPED:
        return detect_objects(scan.frames, load_detector(options.device), surfaces=surfaces)
    model = load_huggingface(options.detector, options.device)
    found = [model(frame) for frame in scan.frames]

    def complete(rows: Sequence[Sequence[ObjectDetection]]) -> Sequence[Sequence[ObjectDetection]]:
        planes = [surface.plane for surface in surfaces]
        return completed(scan.frames, rows, planes, lambda: load_detector(options.device))

    return place_detections(scan.frames, found, surfaces, complete)


def _posed_images(scan: Scan) -> list[PosedImage]:
    return [
        PosedImage(id, frame.T_world_camera, frame.intrinsics)
        for id, frame in zip(scan.image_ids, scan.frames, strict=True)
        if frame.T_world_camera is not None
    ]


def _summary(objects: Sequence[ObjectEstimate], rejected: Sequence[RejectedObject]) -> str:
    """Return the outcome in one line: number of objects, those left out and why; empty without either."""
    left_out = "; ".join(f"{item.name} is left out: {item.reason}" for item in rejected)
    if objects:
        return f"{len(objects)} objects" + (f"; {left_out}" if left_out else "")
    return f"no object was reconstructed: {left_out}" if left_out else ""


def _doubts(objects: Sequence[ObjectEstimate], n_rejected: int, n_images: int) -> list[str]:
    """Return a warning about the cameras if no object, of those found, fits what several images measured."""
    if n_images < 2 or not (objects or n_rejected) or any(o.status != "implausible" for o in objects):
        return []
    return [
        "no object fits all images: check that scene_camera.json has poses from world to camera with x right,"
        " y down and z forward, translations in millimetres, cam_K for images of this size and depth_scale in"
        " millimetres per unit"
    ]


def _write_pictures(
    folder: RunFolder,
    frames: tuple[RgbdFrame, ...],
    detections: Detections,
    objects: Sequence[ObjectEstimate],
    rejected: Sequence[RejectedObject],
) -> None:
    """Write ``overview.png``: up to three images with detections above and reconstructions below.

    The upper images show the outlines of the support surfaces and the candidates that are no objects, the
    lower ones the objects that are left out, all with the reason.
    """
    chosen = sorted({0, len(frames) // 2, len(frames) - 1})
    rows = []
    for i in chosen:
        seen = draw_detections(frames[i], detections.per_frame[i])
        seen = draw_left_out(seen, [c for c in detections.left_out if c.frame == i])
        whole = draw_estimates(frames[i], objects)
        rows.append(
            np.concatenate(
                [
                    draw_surfaces(seen, frames[i], detections.surfaces),
                    draw_rejected(whole, detections.per_frame[i], rejected),
                ]
            )
        )
    write_atomically(folder.path / "overview.png", png_bytes(np.concatenate(rows, axis=1)))


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
