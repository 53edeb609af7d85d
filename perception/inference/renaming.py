"""Bowls that were taken for mugs or cans while they stood in or on something else, named as they stand alone.

The class network hardly ever mistakes a bowl that stands free. Its mask comes from the depth around the axis
of the estimate, and its shape is reconstructed anew from the same images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from perception.depth_cleaning import clean_frame
from perception.detection.completion import Completer
from perception.detection.geometry import points_of
from perception.inference.reconstruct import ReconstructOptions, reconstruct
from perception.inference.shape_model import Decoder
from perception.inference.standing_masks import standing_masks
from perception.types import (
    CATEGORIES,
    OTHER,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    unclassified,
)

SURE = 0.9  # least probability of a bowl among the classes
KNOWN = 0.2  # least probability that it is of one of the classes
VIEWS = 2  # that show it, at least


def mistaken_bowls(
    estimates: Mapping[int, ObjectEstimate],
    frames: Sequence[RgbdFrame],
    plane: SupportPlane,
    network: Completer,
    decoder: Decoder,
) -> dict[int, ObjectEstimate]:
    """Return the bowls among upright objects of other classes, reconstructed as bowls, by id.

    Args:
        estimates: Objects that stand on the plane, at their poses, by id.
        frames: Images of them, with camera poses.
        plane: Support plane.
        network: Names the classes.
        decoder: Shape prior.
    """
    views = [clean_frame(frame) for frame in frames]
    points = [points_of(view, view.depth > 0) for view in views]
    rows: list[list[ObjectDetection]] = [[] for _ in views]
    for id, estimate in sorted(estimates.items()):
        masks = {} if estimate.category == "bowl" else standing_masks(estimate, views, points, plane)
        if len(masks) < VIEWS:
            continue
        share = bowl_probability(masks, views, plane, network)
        if share > SURE:
            for k, mask in masks.items():
                rows[k].append(ObjectDetection("bowl", share, mask, instance_id=id))
    if not any(rows):
        return {}
    return {e.id: e for e in reconstruct(frames, rows, decoder, plane, options=ReconstructOptions(workers=1))}


def bowl_probability(
    masks: Mapping[int, Bool[np.ndarray, "H W"]],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    network: Completer,
) -> float:
    """Return the probability of a bowl among the classes; 0 where it may be of no class.

    Args:
        masks: Masks of an object by the index of the view.
        views: Images.
        plane: Support plane.
        network: Names the classes.
    """
    seen = [network.complete(views[k], plane, [unclassified(mask)])[0] for k, mask in masks.items()]
    weights = [int(mask.sum()) for mask in masks.values()]
    p: Float[np.ndarray, "k"] = np.average([d.class_probabilities for d in seen], axis=0, weights=weights)
    known = float(p[:OTHER].sum())
    return float(p[CATEGORIES.index("bowl")]) / known if known > KNOWN else 0.0
