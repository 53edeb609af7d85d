"""Metrics of reconstructed surfaces, as used in the paper.

With P points sampled uniformly on the estimated surface and Q on the true one, d(p, Q) the distance to the
nearest of the other set:

    accuracy      mean over P of d(p, Q)                       (Mescheder et al., CVPR 2019)
    completeness  mean over Q of d(q, P)                       (same)
    chamfer-L1    (accuracy + completeness) / 2                (same)
    completion    share of Q with d(q, P) < 1 cm               (Li et al., CVPR 2020)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
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


@dataclass(frozen=True)
class SurfaceSamples:
    """Points spread uniformly over a surface.

    Attributes:
        points: (n, 3) in [m].
        normals: (n, 3) of the triangles they lie on, of length 1.
        faces: (n,) these triangles.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "n"]

    @staticmethod
    def of(mesh: TriangleMesh, rng: np.random.Generator, n: int = SAMPLES) -> SurfaceSamples:
        import trimesh  # slow to import

        surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        points, faces = trimesh.sample.sample_surface(surface, n, seed=rng)[:2]
        return SurfaceSamples(np.asarray(points), surface.face_normals[faces], np.asarray(faces))

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.points)

    def distance(self, points: Float[np.ndarray, "m 3"], limit: float = np.inf) -> Float[np.ndarray, "m"]:
        """Return the distance of each point to the nearest sample, in metres; infinite beyond a limit."""
        if not np.isfinite(limit):
            return np.asarray(self.tree.query(points)[0])
        low, high = self.points.min(axis=0) - limit, self.points.max(axis=0) + limit
        near = ((points >= low) & (points <= high)).all(axis=1)  # in a scene most points are far away
        distance = np.full(len(points), np.inf)
        distance[near] = self.tree.query(points[near], distance_upper_bound=limit)[0]
        return distance

    def distance_along_normal(self, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m"]:
        """Return the distance in metres of each point to the tangent plane at the nearest sample.

        Unlike ``distance`` it is free of the samples' spacing.
        """
        nearest = self.tree.query(points)[1]
        return np.abs(((points - self.points[nearest]) * self.normals[nearest]).sum(axis=1))


def sample_surface(
    mesh: TriangleMesh, rng: np.random.Generator, n: int = SAMPLES
) -> Float[np.ndarray, "n 3"]:
    """Return points distributed uniformly over the surface."""
    return SurfaceSamples.of(mesh, rng, n).points


def compare_surfaces(
    estimate: SurfaceSamples, truth: SurfaceSamples, threshold: float = COMPLETION_DISTANCE
) -> ReconstructionMetrics:
    """Return the metrics of two sampled surfaces, with ``threshold`` in metres for the completion."""
    to_truth, to_estimate = truth.distance(estimate.points), estimate.distance(truth.points)
    return ReconstructionMetrics(
        accuracy=float(to_truth.mean()),
        completeness=float(to_estimate.mean()),
        chamfer_l1=float((to_truth.mean() + to_estimate.mean()) / 2),
        completion=float((to_estimate < threshold).mean()),
    )


def reconstruction_metrics(
    mesh_estimate: TriangleMesh,
    mesh_truth: TriangleMesh,
    rng: np.random.Generator,
    n: int = SAMPLES,
    threshold: float = COMPLETION_DISTANCE,
) -> ReconstructionMetrics:
    """Compare two meshes in the same frame.

    Args:
        mesh_estimate: Reconstructed surface.
        mesh_truth: True surface.
        rng: Source of the sample points.
        n: Number of points on each surface.
        threshold: Largest distance of a true point that counts as reconstructed, in metres.
    """
    estimate, truth = (SurfaceSamples.of(mesh, rng, n) for mesh in (mesh_estimate, mesh_truth))
    return compare_surfaces(estimate, truth, threshold)


def point_recall(
    estimate: SurfaceSamples, points: Float[np.ndarray, "m 3"], distance: float = RECALL_DISTANCE
) -> float:
    """Return the share of true points within a distance of the surface in metres; NaN without points."""
    return float((estimate.distance(points) < distance).mean()) if len(points) else float("nan")
