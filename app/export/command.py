"""``nodeslam export RUN``: the reconstructed scene as meshes or as a simulation-ready model."""

from __future__ import annotations

import time

from rich.markup import escape
from rich.table import Table

from app.export.glb import glb_bytes
from app.export.mjcf import write_mjcf
from app.export.model import RigidModel, rigid_model
from app.export.urdf import write_urdf
from app.options import ExportOptions
from app.runs.finished_run import read_run
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.io.files import write_atomically


def run(options: ExportOptions, screen: Screen) -> Report:
    """Write the object map of a run in another format."""
    begin = time.perf_counter()
    source = read_run(options.run)
    folder = RunFolder.create(options, "export")
    models = []
    with screen.stage("Building rigid bodies"):
        for done, estimate in enumerate(source.objects):
            screen.update(f"{done} of {len(source.objects)}: {estimate.name.replace('_', ' ')}")
            models.append(rigid_model(estimate))
    with screen.stage(f"Writing {options.format}"):
        if options.format == "glb":
            path = folder.path / "scene.glb"
            write_atomically(path, glb_bytes(source.objects))
        elif options.format == "mjcf":
            path = write_mjcf(folder.path, models, source.plane)
        else:
            path = write_urdf(folder.path, models)
    report = Report(
        command="export",
        seed=options.seed,
        success=True,
        reason=f"{len(models)} objects in {path.name}",
        timings={"total": time.perf_counter() - begin},
        objects=[ObjectReport(m.estimate.id, m.estimate.category, details=_details(m)) for m in models],
        metrics={"file": str(path), "format": options.format},
        settings={"run": str(options.run), "format": options.format},
    )
    folder.write_report(report)
    screen.show(_table(models))
    screen.show(escape(f"{path}"))
    return report


def _details(model: RigidModel) -> dict[str, float | int]:
    return {
        "height": model.estimate.height,
        "radius": model.estimate.radius,
        "volume": model.volume,
        "mass": model.mass,
        "n_pieces": len(model.pieces),
    }


def _table(models: list[RigidModel]) -> Table:
    table = Table(title=f"{len(models)} objects", title_justify="left", show_edge=False, pad_edge=False)
    for heading in ("object", "height", "radius", "material", "mass", "convex pieces"):
        table.add_column(heading, justify="left" if heading == "object" else "right")
    for model in models:
        estimate = model.estimate
        lengths = (f"{1000 * estimate.height:.0f} mm", f"{1000 * estimate.radius:.0f} mm")
        amounts = (f"{1e6 * model.volume:.0f} cm³", f"{1000 * model.mass:.0f} g", str(len(model.pieces)))
        table.add_row(estimate.name, *lengths, *amounts)
    return table
