"""How good a reconstruction is, as the paper measures it.

With P points sampled uniformly on the estimated surface and Q on the true one, d(p, Q) the distance to the
nearest of the other set:

    accuracy      mean over P of d(p, Q)                       (Mescheder et al., CVPR 2019)
    completeness  mean over Q of d(q, P)                       (same)
    chamfer-L1    (accuracy + completeness) / 2                (same)
    completion    share of Q with d(q, P) < 1 cm               (Li et al., CVPR 2020)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree

from perception.types import TriangleMesh

SAMPLES = 20_000
COMPLETION_DISTANCE = 0.01
RECALL_DISTANCE = 0.005


@dataclass(frozen=True)
class ReconstructionMetrics:
    """Lengths in [m], completion in 0..1."""

    accuracy: float
    completeness: float
    chamfer_l1: float
    completion: float


def sample_surface(
    mesh: TriangleMesh, rng: np.random.Generator, n: int = SAMPLES
) -> Float[np.ndarray, "n 3"]:
    """Points uniform over the surface."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return np.asarray(trimesh.sample.sample_surface(surface, n, seed=rng)[0])


def reconstruction_metrics(
    mesh_estimate: TriangleMesh,
    mesh_truth: TriangleMesh,
    rng: np.random.Generator,
    n: int = SAMPLES,
    threshold: float = COMPLETION_DISTANCE,
) -> ReconstructionMetrics:
    """Compares two meshes given in one frame.

    Args:
        mesh_estimate: the reconstruction.
        mesh_truth: the true surface.
        rng: draws the sample points.
        n: points on each.
        threshold: distance within which a true point counts as reconstructed [m].
    """
    estimate, truth = sample_surface(mesh_estimate, rng, n), sample_surface(mesh_truth, rng, n)
    to_truth, _ = KDTree(truth).query(estimate)
    to_estimate, _ = KDTree(estimate).query(truth)
    return ReconstructionMetrics(
        accuracy=float(to_truth.mean()),
        completeness=float(to_estimate.mean()),
        chamfer_l1=float((to_truth.mean() + to_estimate.mean()) / 2),
        completion=float((to_estimate < threshold).mean()),
    )


def point_recall(
    mesh_estimate: TriangleMesh,
    points: Float[np.ndarray, "m 3"],
    rng: np.random.Generator,
    distance: float = RECALL_DISTANCE,
    n: int = SAMPLES,
) -> float:
    """Share of the given true surface points (a handle's, say) within a distance of the reconstruction."""
    if not len(points):
        return float("nan")
    nearest, _ = KDTree(sample_surface(mesh_estimate, rng, n)).query(points)
    return float((nearest < distance).mean())
