"""Figures of ``evaluate reconstruction``: convergence, and the best, median and worst object by class."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from app.evaluation.reconstruction_object import (
    Sight,
    Subject,
    load_sight,
    reconstruct_subject,
    shared_decoder,
)
from app.options import EvaluateOptions
from app.runs.report import Report
from perception.geometry import invert, transform_points
from perception.types import RgbdFrame, TriangleMesh

Image = UInt8[np.ndarray, "h w 3"]

COLORS = {
    "full": "#009e73",
    "no_refinement": "#444444",
    "no_uncertainty": "#e69f00",
    "no_pyramid": "#56b4e9",
    "dvr": "#d55e00",
    "mask_only": "#cc79a7",
}
SIZE = 340  # [px] side of each image of an object
ERROR_RANGE = 0.006  # [m] upper end of the colour scale of errors


def write_pictures(
    folder: Path, report: Report, subjects: Mapping[str, Subject], options: EvaluateOptions
) -> None:
    """Write ``convergence.png``, and ``objects_<class>.png`` with truth and estimates."""
    curves = report.metrics["convergence"]
    if curves:
        _save(_convergence_plot(curves), folder / "convergence.png")
    if "full" not in options.methods:
        return
    views = max(options.views)
    rows = [
        row
        for row in report.metrics["rows"]
        if (row["method"], row["views"]) == ("full", views) and row["found"]
    ]
    for category in dict.fromkeys(row["category"] for row in rows):
        ranked = sorted((row for row in rows if row["category"] == category), key=_chamfer_of)
        chosen = {"best": ranked[0], "median": ranked[(len(ranked) - 1) // 2], "worst": ranked[-1]}
        figure = _gallery(chosen, subjects, views, options)
        _save(figure, folder / f"objects_{category}.png")


def _chamfer_of(row: Mapping[str, Any]) -> float:
    return row["chamfer_l1"]


def _save(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure)
    figure.savefig(path)


def _convergence_plot(curves: Mapping[str, Mapping[str, Any]]) -> Figure:
    figure = Figure(figsize=(8, 4.5), dpi=130, layout="constrained")
    axes = figure.subplots()
    for method, curve in curves.items():
        values = [np.nan if v is None else 1000 * v for v in curve["chamfer_l1"]]
        axes.plot(curve["iteration"], values, color=COLORS.get(method), lw=2, label=method.replace("_", " "))
    axes.set_yscale("log")
    ticks = [1, 2, 3, 5, 10, 20, 50, 100]
    axes.set_yticks(ticks, [str(tick) for tick in ticks], minor=False)
    axes.minorticks_off()
    axes.axvline(30, color="0.6", lw=1, ls="--")
    axes.set(xlabel="iteration", ylabel="chamfer-L1 [mm], median")
    axes.set_title("Convergence from one view; the product stops at the dashed line", loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    return figure


def _gallery(
    chosen: Mapping[str, Mapping[str, Any]],
    subjects: Mapping[str, Subject],
    views: int,
    options: EvaluateOptions,
) -> Figure:
    """Return a row per object: first image; truth, estimate and error from its camera and from behind."""
    figure = Figure(figsize=(15.5, 2.0 * len(chosen) + 0.4), dpi=100)
    axes = figure.subplots(len(chosen), 7, squeeze=False)
    figure.subplots_adjust(left=0.055, right=0.925, top=0.93, bottom=0.01, wspace=0.03, hspace=0.03)
    colors = ScalarMappable(Normalize(0, 1000 * ERROR_RANGE), "turbo")
    for axis_row, (rank, row) in zip(axes, chosen.items()):
        subject = subjects[row["object"]]
        sight = load_sight(options, subject)
        estimate = reconstruct_subject(sight, views, "full", shared_decoder(options.device))
        assert estimate is not None
        for axis, picture in zip(axis_row, _row_of_pictures(sight, estimate.mesh_world, colors)):
            axis.imshow(picture)
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        figures = f"{1000 * row['accuracy']:.2f} / {1000 * row['chamfer_l1']:.2f} mm"
        axis_row[0].set_ylabel(f"{rank}\n{figures}\n{100 * row['completion']:.1f} %", fontsize=10)
    titles = (
        "first view",
        "truth",
        "estimate",
        "error",
        "truth, behind",
        "estimate, behind",
        "error, behind",
    )
    for axis, title in zip(axes[0], titles):
        axis.set_title(title, fontsize=11)
    scale = figure.add_axes((0.935, 0.1, 0.012, 0.75))
    figure.colorbar(colors, cax=scale, label="distance to the true surface [mm]")
    return figure


def _row_of_pictures(sight: Sight, estimate: TriangleMesh, colors: ScalarMappable) -> list[Image]:
    truth = sight.truth.mesh_world
    centre = sight.truth.samples.points.mean(axis=0)
    reach = float(np.linalg.norm(sight.truth.samples.points - centre, axis=1).max())
    error = sight.truth.samples.distance_along_normal(estimate.vertices[estimate.faces].mean(axis=1))
    red = np.asarray(colors.to_rgba(1000 * error))[:, :3] * 255
    pictures = [_cut_out(sight.frames[0], centre, reach)]
    here = np.asarray(sight.frames[0].T_world_camera)[:3, 3]
    behind = np.array([2 * centre[0] - here[0], 2 * centre[1] - here[1], here[2]])
    for eye in (here, behind):
        for mesh, paint in ((truth, (170, 176, 188)), (estimate, (86, 180, 233)), (estimate, red)):
            pictures.append(_shaded(mesh, np.broadcast_to(paint, (len(mesh.faces), 3)), eye, centre, reach))
    return pictures


def _cut_out(frame: RgbdFrame, centre: Float[np.ndarray, "3"], reach: float) -> Image:
    assert frame.T_world_camera is not None
    x, y, z = transform_points(invert(frame.T_world_camera), centre[None])[0]
    k = frame.intrinsics
    u, v, half = k.fx * x / z + k.cx, k.fy * y / z + k.cy, 1.05 * k.fx * reach / z
    to_picture = np.array([[SIZE / (2 * half), 0, 0], [0, SIZE / (2 * half), 0]], dtype=np.float64)
    to_picture[:, 2] = SIZE / 2 - to_picture[:, :2] @ (u, v)
    return np.asarray(cv2.warpAffine(np.asarray(frame.rgb), to_picture, (SIZE, SIZE)))


def _shaded(
    mesh: TriangleMesh, colors: np.ndarray, eye: np.ndarray, centre: np.ndarray, reach: float
) -> Image:
    """Render a mesh with Lambertian shading by the painter's algorithm."""
    forward = (centre - eye) / np.linalg.norm(centre - eye)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facing = ((corners.mean(axis=1) - eye) * normals).sum(axis=1) < 0
    local = (corners[facing] - eye) @ axes.T
    focal = SIZE / 2 / (1.05 * reach) * np.linalg.norm(centre - eye)
    flat = SIZE / 2 + focal * local[..., :2] / local[..., 2:]
    towards_light = np.array([0.0, 0.0, 0.7]) - 0.7 * forward + 0.3 * right
    light = 0.35 + 0.65 * np.clip(normals[facing] @ towards_light / np.linalg.norm(towards_light), 0, 1)
    lit = np.clip(light[:, None] * colors[facing], 0, 255)
    image = np.full((SIZE, SIZE, 3), 255, np.uint8)
    fixed = np.rint(flat * 8).astype(np.int32)
    for i in np.argsort(-local[..., 2].mean(axis=1)):
        cv2.fillConvexPoly(image, fixed[i], lit[i].tolist(), cv2.LINE_8, 3)
    return image
