"""``nodeslam reconstruct SCAN``: objects from a scan folder, on a machine without any simulator."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from rich.markup import escape
from rich.table import Table

from app.drawing import draw_detections, draw_estimates
from app.options import ReconstructOptions
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.detection.association import associate
from perception.errors import InvalidInputError
from perception.io.files import write_atomically
from perception.io.object_map import write_object_map
from perception.io.scan_folder import Scan, png_bytes, read_scan, write_scan
from perception.pipeline import (
    SHIPPED,
    Detections,
    load_decoder,
    load_detector,
    load_huggingface,
    reconstruct_objects,
)
from perception.pipeline import detect as detect_objects
from perception.support_plane import fit_support_plane
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane


def run(options: ReconstructOptions, screen: Screen) -> Report:
    """Detect where the folder has no detections, reconstruct, and write the object map."""
    begin = time.perf_counter()
    timings: dict[str, float] = {}
    recorded = read_scan(options.scan)
    # Without poses nothing says which way is up: the plane may lie at any angle to the first camera.
    plane = fit_support_plane(recorded.frames if recorded.has_poses else recorded.frames[:1])
    scan = usable(recorded)
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
    with screen.stage("Reconstructing whole shapes"):
        objects = reconstruct_objects(
            scan.frames, detections, decoder, lambda done, total, what: screen.update(f"{done} of {total}")
        )
    timings["reconstruct"] = time.perf_counter() - started
    write_scan(folder.scan, scan.frames, detections.per_frame)
    write_object_map(folder.path, objects)
    _write_pictures(folder, scan.frames, detections, objects)
    report = Report(
        command="reconstruct",
        seed=options.seed,
        success=bool(objects),
        reason=f"{len(objects)} objects" if objects else "no object was found in the scan",
        timings=timings | {"total": time.perf_counter() - begin},
        objects=[ObjectReport(o.id, o.category, details=_details(o)) for o in objects],
        metrics={"n_images": len(scan.frames), "n_objects": len(objects)},
        warnings=scan.warnings,
        settings={"scan": str(options.scan)},
    )
    folder.write_report(report)
    screen.show(_table(objects))
    screen.show(escape(f"meshes in {folder.path / 'objects'}, the list in objects.json"))
    return report


def usable(scan: Scan) -> Scan:
    """The scan with every frame posed: without poses the first camera is the world, the others useless."""
    if scan.has_poses:
        return scan
    first = replace(scan.frames[0], T_world_camera=np.eye(4))
    dropped = len(scan.frames) - 1
    note = (
        (f"the scan has no camera poses: {dropped} images after the first are not used",) if dropped else ()
    )
    detections, masks = scan.detections and scan.detections[:1], scan.masks and scan.masks[:1]
    return Scan((first,), detections, scan.image_ids[:1], (*scan.warnings, *note), masks)


def _detections(scan: Scan, plane: SupportPlane, options: ReconstructOptions) -> Detections:
    """The folder's own detections or masks where it has them, else the detector's; tied over the images."""
    if scan.detections is not None:
        if not any(scan.detections):
            raise InvalidInputError(
                f"{options.scan}/detections.json is empty: delete it to use the shipped detector"
            )
        if all(found.instance_id is not None for frame in scan.detections for found in frame):
            return Detections(plane, scan.detections)
        found = scan.detections
    elif scan.masks is not None:
        detector = load_detector(options.device)
        found = [detector.classify(frame, plane, masks) for frame, masks in zip(scan.frames, scan.masks)]
    elif options.detector != SHIPPED:
        model = load_huggingface(options.detector, options.device)
        found = [model(frame) for frame in scan.frames]
    else:
        return detect_objects(scan.frames, load_detector(options.device), plane=plane)
    return Detections(plane, tuple(map(tuple, associate(scan.frames, found, plane))))


def _write_pictures(
    folder: RunFolder, frames: tuple[RgbdFrame, ...], detections: Detections, objects: list[ObjectEstimate]
) -> None:
    """``overview.png``: up to three images, what was found in them above, whole shapes below."""
    chosen = sorted({0, len(frames) // 2, len(frames) - 1})
    found = np.concatenate([draw_detections(frames[i], detections.per_frame[i]) for i in chosen], axis=1)
    whole = np.concatenate([draw_estimates(frames[i], objects) for i in chosen], axis=1)
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
