"""Screening of classes and resting poses: which of them come near an object's depth at all.

A few coarse iterations on a few views tell a lying bottle from an upright mug at a tenth of the time of a
complete fit. They do not tell a lying can from a lying bottle: the nearest hypotheses are kept for complete
fits to decide.
"""

from __future__ import annotations

from dataclasses import replace

from perception.errors import PerceptionError
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.optimisation import coarse_residual
from perception.inference.shape_model import Decoder
from perception.types import POSED_CLASSES, PosedClass, RestingPose, SupportPlane

VIEWS = 2
MOST = 3  # hypotheses that are kept
NEAR = 0.012  # [m] largest coarse residual of a hypothesis that is kept
RELATIVE = 1.8  # the same, relative to the smallest one
NO_FARTHER = 1.1  # largest coarse residual of another pose, relative to that of the upright one


def nearest_hypotheses(
    views: ObjectViews, decoder: Decoder, plane: SupportPlane, config: FitConfig = FitConfig()
) -> list[PosedClass]:
    """Return the classes and resting poses that come near an object's depth, the nearest first.

    Args:
        views: Observations of the object, the largest first; its class is not used.
        decoder: Shape prior.
        plane: What the object rests on.
        config: Settings of the fits.
    """
    residuals: dict[PosedClass, float] = {
        (c, r): _residual(replace(views, category=c), decoder, plane, r, config) for c, r in POSED_CLASSES
    }
    limit = min(NEAR, RELATIVE * min(residuals.values()))
    near = sorted((h for h, residual in residuals.items() if residual <= limit), key=residuals.__getitem__)
    return near[:MOST]


def comes_near(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    resting: RestingPose,
    config: FitConfig = FitConfig(),
) -> bool:
    """Return whether an object of known class comes about as near to its depth in a pose as upright."""
    residual, upright = (_residual(views, decoder, plane, pose, config) for pose in (resting, "upright"))
    return residual < NO_FARTHER * upright


def _residual(
    views: ObjectViews, decoder: Decoder, plane: SupportPlane, resting: RestingPose, config: FitConfig
) -> float:
    """Return the coarse residual in metres; infinite where no view shows what the pose starts from."""
    few = replace(views, observations=views.observations[:VIEWS])
    try:
        return coarse_residual(few, decoder, plane, replace(config, resting=resting))
    except PerceptionError:
        return float("inf")
