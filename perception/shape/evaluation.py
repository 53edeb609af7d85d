"""Reconstruction accuracy of the shape prior on held-out shapes: IoU, surface error, handle recall.

Lengths are in voxels of the 32^3 grid. The longest side of an object is 28.8 voxels: a voxel is 3.5 mm of a
100 mm object.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from perception.shape.dataset import ShapeDataset, occupancies
from perception.shape.losses import handle_region
from perception.shape.network import ShapeVae, class_one_hot
from perception.types import CATEGORIES, Category

ISO_LEVEL = 0.5  # occupancy of the surface
OBJECT_VOXELS = 28.8  # [voxel]; longest side of an object, 0.9 of the grid
HANDLE_TOLERANCE = 1.5  # [voxel]; 5 mm on a mug of 100 mm
_BATCH_SIZE = 64


@dataclass(frozen=True)
class ShapeScores:
    """Accuracy of the reconstructions of one class.

    Attributes:
        n: Number of shapes.
        iou: Median intersection over union of the voxels above 0.5, in 0..1.
        surface: Median symmetric mean distance of the surfaces at 0.5 (Chamfer-L1) in [voxel].
        handle_recall: Mean share of the handle's surface within 1.5 voxels of the reconstruction, in 0..1;
            NaN for classes without handles.
        code_spread: Root mean square of the code entries; 1 if codes follow the prior N(0, I).
    """

    n: int
    iou: float
    surface: float
    handle_recall: float
    code_spread: float


def evaluate(
    model: ShapeVae, data: ShapeDataset, device: str | torch.device = "cpu", max_surfaces: int = 100
) -> dict[Category, ShapeScores]:
    """Return the accuracy of encoded and decoded shapes for each class in the data.

    Surfaces are compared for the first ``max_surfaces`` shapes of each class.
    """
    scores: dict[Category, ShapeScores] = {}
    for category in CATEGORIES:
        shapes = data.of(category)
        if len(shapes):
            scores[category] = _evaluate_class(model, shapes, device, max_surfaces)
    return scores


def _evaluate_class(
    model: ShapeVae, shapes: ShapeDataset, device: str | torch.device, max_surfaces: int
) -> ShapeScores:
    truth = occupancies(shapes.grids)
    codes = encode(model, truth, shapes.categories, device)
    decoded = decode(model, codes, shapes.categories, device)
    handles = handle_region(shapes.grids, shapes.categories)
    chosen = range(min(len(shapes), max_surfaces))
    surfaces = [surface_error(decoded[i], truth[i]) for i in chosen]
    recalls = [handle_recall(decoded[i], truth[i], handles[i]) for i in chosen if handles[i].any()]
    return ShapeScores(
        n=len(shapes),
        iou=float(np.median([iou(a, b) for a, b in zip(decoded, truth)])),
        surface=float(np.median(surfaces)),
        handle_recall=float(np.nanmean(recalls)) if recalls else float("nan"),
        code_spread=float(np.sqrt(np.mean(codes**2))),
    )


@torch.no_grad()
def encode(
    model: ShapeVae,
    grids: Float[np.ndarray, "n 32 32 32"],
    categories: Int[np.ndarray, "n"],
    device: str | torch.device = "cpu",
) -> Float[np.ndarray, "n 16"]:
    """Return the mean codes of occupancy grids."""
    model.eval()
    means = []
    for start in range(0, len(grids), _BATCH_SIZE):
        part = slice(start, start + _BATCH_SIZE)
        one_hot = class_one_hot(torch.from_numpy(categories[part])).to(device)
        means.append(model.encoder(torch.from_numpy(grids[part]).to(device), one_hot)[0].cpu())
    return torch.cat(means).numpy()


@torch.no_grad()
def decode(
    model: ShapeVae,
    codes: Float[np.ndarray, "n 16"],
    categories: Int[np.ndarray, "n"],
    device: str | torch.device = "cpu",
) -> Float[np.ndarray, "n 32 32 32"]:
    """Return the occupancy grids of codes."""
    model.eval()
    grids = []
    for start in range(0, len(codes), _BATCH_SIZE):
        part = slice(start, start + _BATCH_SIZE)
        one_hot = class_one_hot(torch.from_numpy(categories[part])).to(device)
        grids.append(torch.sigmoid(model.decoder(torch.from_numpy(codes[part]).to(device), one_hot)).cpu())
    return torch.cat(grids).numpy()


def iou(a: Float[np.ndarray, "x y z"], b: Float[np.ndarray, "x y z"]) -> float:
    """Return the intersection over union of the voxels above 0.5; 1 if both grids are empty."""
    a, b = a > ISO_LEVEL, b > ISO_LEVEL
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def surface_error(a: Float[np.ndarray, "x y z"], b: Float[np.ndarray, "x y z"]) -> float:
    """Return the symmetric mean distance of the surfaces at 0.5 in [voxel]; infinite if a grid has none."""
    points_a, points_b = surface_points(a), surface_points(b)
    if not len(points_a) or not len(points_b):
        return float("inf")
    to_b = KDTree(points_b).query(points_a)[0]
    to_a = KDTree(points_a).query(points_b)[0]
    return float(0.5 * (to_b.mean() + to_a.mean()))


def handle_recall(
    decoded: Float[np.ndarray, "x y z"],
    truth: Float[np.ndarray, "x y z"],
    region: Bool[np.ndarray, "x y z"],
) -> float:
    """Return the share of the true surface in the region within ``HANDLE_TOLERANCE`` of the decoded one.

    NaN if the region contains no true surface.
    """
    points = surface_points(truth)
    points = points[region[tuple(np.rint(points).astype(int).T)]]
    if not len(points):
        return float("nan")
    found = surface_points(decoded)
    if not len(found):
        return 0.0
    return float(np.mean(KDTree(found).query(points)[0] < HANDLE_TOLERANCE))


def surface_points(grid: Float[np.ndarray, "x y z"]) -> Float[np.ndarray, "n 3"]:
    """Return points on the surface at 0.5 in voxels: vertices, edge and face centres of marching cubes.

    They are about a third of a voxel apart, which biases nearest-point distances upwards by a few hundredths.
    """
    if not grid.min() < ISO_LEVEL < grid.max():
        return np.zeros((0, 3))
    vertices, faces, _, _ = marching_cubes(grid, ISO_LEVEL)
    corners = vertices[faces]  # (f, 3 corners, 3)
    return np.concatenate(
        [vertices, corners.mean(1), 0.5 * (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)]
    )


def describe(scores: Mapping[Category, ShapeScores]) -> str:
    """Format the scores as one line for the log."""
    return "; ".join(
        f"{category} IoU {s.iou:.3f}, surface {s.surface:.2f} voxel"
        + (f", handle recall {s.handle_recall:.2f}" if np.isfinite(s.handle_recall) else "")
        for category, s in scores.items()
    )
