"""The surfaces in depth images that objects stand on, the main one first.

The plane with the most points is often the floor or a wall. A surface is chosen by what was seen of it, near
the camera rather than far away, and above all by what stands on it. Further surfaces are parallel to the
main one, since both are level, and carry things too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from perception.detection.geometry import camera_pose
from perception.errors import InvalidInputError, PerceptionError
from perception.support.extent import Extent, ExtentConfig, seen_extent
from perception.support.planes import PlaneConfig, candidate_planes, refined
from perception.support.samples import Samples, sample_frames
from perception.support.surface import SupportSurface
from perception.support.things import ThingConfig, is_vessel_bottom, things_on
from perception.types import RgbdFrame, SupportPlane


@dataclass(frozen=True)
class SurfaceConfig:
    """Parameters of the search for surfaces.

    Attributes:
        planes: Parameters of the candidate planes.
        extent: Parameters of their extents.
        things: What counts as a thing on a surface.
        max_surfaces: Largest number of surfaces.
        max_angle: Largest angle between the normals of two surfaces, in radians.
        min_step: Smallest height of a surface above or below another one, in metres; a thinner step is within
            what an object may stand off its plane.
        thing_weight: Weight of a sample of a thing relative to one of the surface, for at most as many as the
            surface has: all that is in a box rises from its side, which carries nothing.
        bare: Factor on the score of a surface without things.
        full_weight, no_weight: Depths in metres up to which samples count fully, and from which not at all.
        opposed: Factor on the score of a plane without camera pose that another one faces: sides of a box.
        least_upright: Smallest factor for the attitude of a camera without pose (``_uprightness``).
    """

    planes: PlaneConfig = field(default_factory=PlaneConfig)
    extent: ExtentConfig = field(default_factory=ExtentConfig)
    things: ThingConfig = field(default_factory=ThingConfig)
    max_surfaces: int = 3
    max_angle: float = 0.14
    min_step: float = 0.02
    thing_weight: float = 2.0
    bare: float = 0.2
    full_weight: float = 1.0
    no_weight: float = 2.5
    opposed: float = 0.2
    least_upright: float = 0.25


@dataclass(frozen=True)
class _Candidate:
    extent: Extent
    n_things: int
    score: float


def find_surfaces(
    frames: Sequence[RgbdFrame], config: SurfaceConfig = SurfaceConfig(), seed: int = 0
) -> tuple[SupportSurface, ...]:
    """Find the surfaces that things stand on; their normals point towards the cameras.

    Args:
        frames: Frames with poses, or a single one, whose pose may be unknown. World z should be up; where no
            plane is level then, as with poses relative to the first camera, planes may have any orientation.
        config: Parameters.
        seed: Seed of RANSAC.

    Returns:
        The main surface, then others with things on them, highest score first; in the world frame, or in the
        camera frame for a frame without pose. The main surface may be bare, and its extent unknown.

    Raises:
        InvalidInputError: There is no frame, or one of several has no pose.
        PerceptionError: There are too few depth points, or no plane has enough inliers.
    """
    if not frames:
        raise InvalidInputError("no support plane without a frame; give at least one RGB-D frame")
    posed = all(frame.T_world_camera is not None for frame in frames)
    if len(frames) > 1 and not posed:
        raise InvalidInputError(
            f"a support plane from {len(frames)} frames needs T_world_camera of each; give one frame or poses"
        )
    samples = sample_frames(
        frames, max(config.planes.max_points // len(frames), 4000), config.planes.max_depth
    )
    n_valid = int(samples.valid.sum())
    if n_valid < 100:
        raise PerceptionError(
            f"No support plane: only {n_valid} depth points within {config.planes.max_depth:g} m; "
            "check the depth images and their scale"
        )
    planes = candidate_planes(samples, posed, config.planes, np.random.default_rng(seed))
    upright = posed and bool(planes)
    if not upright:
        planes = planes or candidate_planes(samples, False, config.planes, np.random.default_rng(seed))
    if not planes:
        raise PerceptionError(
            f"No support plane: none of {config.planes.iterations} holds {config.planes.min_share:.0%} of "
            f"{n_valid} depth points; show more of the table, or check the poses"
        )
    attitudes = None if upright else np.stack([camera_pose(frame)[:3, :3] for frame in frames])
    candidates = _candidates(samples, planes, attitudes, config)
    if not candidates:
        return (SupportSurface(refined(samples, planes[0], config.planes)),)
    kept: list[_Candidate] = []
    for candidate in candidates:
        if len(kept) < config.max_surfaces and (not kept or _adds(samples, candidate, kept[0], config)):
            kept.append(candidate)
    return tuple(_settled(samples, candidate.extent, config) for candidate in kept)


def _nearness(samples: Samples, config: SurfaceConfig) -> Float[np.ndarray, "n"]:
    """Return the weight of each sample by its depth."""
    share = (config.no_weight - samples.depth) / (config.no_weight - config.full_weight)
    return np.where(samples.valid, np.clip(share, 0, 1), 0)


def _candidates(
    samples: Samples,
    planes: Sequence[SupportPlane],
    attitudes: Float[np.ndarray, "n 3 3"] | None,
    config: SurfaceConfig,
) -> list[_Candidate]:
    """Return the planes that were seen as surfaces, highest score first.

    ``attitudes`` are the rotations of the cameras in a world of unknown orientation; None where z is up.
    """
    extents = [e for plane in planes if (e := seen_extent(samples, plane, config.planes, config.extent))]
    weight = _nearness(samples, config)
    explained = np.zeros(len(weight), bool)
    candidates: list[_Candidate] = []
    for extent in sorted(extents, key=lambda extent: -int(extent.shown.sum())):
        if any(_repeats(extent, other.extent, config) for other in candidates):
            continue
        # A plane that cuts through a larger surface must not take the parts above it for things.
        things, n_things = things_on(samples, extent, explained, config.things)
        explained |= extent.shown
        area, load = weight[extent.shown].sum(), weight[things >= 0].sum()
        score = float(area + config.thing_weight * min(load, area))
        score *= 1.0 if n_things else config.bare
        if attitudes is not None:
            score *= _uprightness(extent.plane, attitudes, config)
            score *= config.opposed if _has_opposite(extent, extents) else 1.0
        candidates.append(_Candidate(extent, n_things, score))
    return sorted(candidates, key=lambda candidate: -candidate.score)


def _uprightness(plane: SupportPlane, attitudes: Float[np.ndarray, "n 3 3"], config: SurfaceConfig) -> float:
    """Return the mean factor for the attitude of the cameras if the plane is level.

    1 for an upright camera that looks down by 30 degrees, say at a table; one half for a view from straight
    above, which a wall in front of a level camera looks like as well; less for walls at the side and in front
    of a camera that looks down.
    """
    normals = plane.normal @ attitudes  # (n, 3) in the frames of the cameras
    right, up = np.abs(normals[:, 0]), -normals[:, 1]
    return float(np.clip(0.5 + up - 0.5 * right, config.least_upright, 1.0).mean())


def _has_opposite(extent: Extent, extents: Sequence[Extent]) -> bool:
    """Return whether a plane of at least half the visible area faces it; none is above a level surface."""
    normal, least = extent.plane.normal, 0.5 * extent.shown.sum()
    return any(normal @ other.plane.normal < -0.9 and other.shown.sum() > least for other in extents)


def _settled(samples: Samples, extent: Extent, config: SurfaceConfig) -> SupportSurface:
    """Return the surface with the plane of the samples in its extent alone."""
    plane = refined(samples, extent.plane, config.planes, among=extent.shown)
    final = seen_extent(samples, plane, config.planes, config.extent) or extent
    return SupportSurface(final.plane, final.grid.polygon(final.hull))


def _repeats(extent: Extent, other: Extent, config: SurfaceConfig) -> bool:
    """Return whether a surface is part of another one that is not quite flat or measured with a bias."""
    return abs(float(np.median(other.height[extent.shown]))) < config.min_step


def _adds(samples: Samples, candidate: _Candidate, main: _Candidate, config: SurfaceConfig) -> bool:
    """Return whether a candidate carries things, is as level as the main surface, and no bowl's bottom."""
    normals = candidate.extent.plane.normal, main.extent.plane.normal
    level = bool(normals[0] @ normals[1] > np.cos(config.max_angle))
    vessel = level and is_vessel_bottom(samples, candidate.extent, config.things)
    return candidate.n_things > 0 and level and not vessel
