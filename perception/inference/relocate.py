"""Search for an object of known shape anywhere on its support, in any resting pose.

Poses that the depth of all images agrees with are found without rendering, and the best are fitted; what does
not stand, with its axis reversed as well, for a search may miss one of two poses that look alike. A pose is
accepted only if the images show the object there, and if it explains nearly all that is measured around it:
either alone would accept a piece of something else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from perception.geometry import transform_points
from perception.inference.depth_votes import DepthVotes, SearchScene, VisibleSamples
from perception.inference.pose_candidates import CandidateConfig, pose_candidates
from perception.inference.refit import PoseCheck, RefitConfig, refit_pose
from perception.types import ObjectEstimate

_STANDS = np.cos(np.deg2rad(30))  # component of the axis along the vertical from which on an object stands


@dataclass(frozen=True)
class RelocateConfig:
    """Settings of the search.

    Attributes:
        stride: Every ``stride``-th pixel of each image is used.
        min_height: Least height above the support of a point that is not part of it, in metres.
        explained: Distance from another object's surface within which a point belongs to it, in metres.
        min_points: Least number of points that nothing else explains.
        near: Distance from the posed surface within which it explains a point, in metres.
        around: Distance within which it should, in metres.
        min_coverage: Least share of the points around it that it must explain.
        min_score: Least score of an accepted pose (``DepthVotes.score``).
        alike: Difference of scores below which two poses are equally likely.
        samples: Number of points on the object's surface.
        candidates: Settings of the search before the fits.
        refit: Settings of the fits; any orientation is as likely as the candidate's.
    """

    stride: int = 5
    min_height: float = 0.012
    explained: float = 0.012
    min_points: int = 40
    near: float = 0.010
    around: float = 0.030
    min_coverage: float = 0.85
    min_score: float = 0.45
    alike: float = 0.08
    samples: int = 1500
    candidates: CandidateConfig = CandidateConfig()
    refit: RefitConfig = RefitConfig(tilt_sigma=10.0)


def relocate(
    estimate: ObjectEstimate,
    scene: SearchScene,
    config: RelocateConfig = RelocateConfig(),
    T_before: Float[np.ndarray, "4 4"] | None = None,
) -> PoseCheck | None:
    """Return the pose of an object on its support; None if no image shows it.

    Args:
        estimate: Object of known shape; its pose is not used.
        scene: Images, and what else explains their depth.
        config: Settings.
        T_before: (4, 4) last known pose. Of poses that the images show equally well, as the two directions of
            a can, the one with its base nearest to where it was is returned: things tip over their base.
    """
    votes = DepthVotes.of(scene, config.stride, config.min_height, config.explained)
    if len(votes.points) < config.min_points:
        return None
    samples = VisibleSamples(estimate.mesh, config.samples)

    def judged(T: Float[np.ndarray, "4 4"]) -> list[tuple[float, PoseCheck]]:
        """Return the fit that starts at a pose and its score, if it is accepted."""
        check = refit_pose(estimate, scene.frames, T, scene.others, scene.plane, config.refit)
        T = check.T_world_object
        score = float(votes.score(samples, T[:3, :3], T[None, :3, 3], config.near)[0])
        coverage = _coverage(transform_points(T, samples.points), votes.points, config)
        is_there = check.status == "seen" and score > config.min_score and coverage > config.min_coverage
        return [(score, check)] if is_there else []

    candidates = pose_candidates(estimate, votes, scene.plane, config.candidates)
    found = [fit for candidate in candidates for fit in judged(candidate.T_world_object)]
    for _, check in list(found):
        if check.T_world_object[2, 2] < _STANDS:
            found += judged(_reversed(check.T_world_object, estimate))
    if not found:
        return None
    best = max(score for score, _ in found)
    if T_before is None:
        return next(check for score, check in found if score == best)
    base = np.array([0.0, 0.0, estimate.mesh.vertices[:, 2].min()])
    was = transform_points(T_before, base)[:2]
    return min(
        (check for score, check in found if score > best - config.alike),
        key=lambda check: float(np.linalg.norm(transform_points(check.T_world_object, base)[:2] - was)),
    )


def _reversed(T_world_object: Float[np.ndarray, "4 4"], estimate: ObjectEstimate) -> Float[np.ndarray, "4 4"]:
    """Return the pose at which the same place is taken with the axis the other way round."""
    T_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    T_turn[2, 3] = estimate.mesh.vertices[:, 2].min() + estimate.mesh.vertices[:, 2].max()
    return T_world_object @ T_turn


def _coverage(
    surface: Float[np.ndarray, "m 3"], points: Float[np.ndarray, "n 3"], config: RelocateConfig
) -> float:
    """Return the share of the points around a posed surface that it explains."""
    distances = KDTree(surface).query(points, distance_upper_bound=config.around)[0]
    return float((distances < config.near).sum() / max(np.isfinite(distances).sum(), 1))
