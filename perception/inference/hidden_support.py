"""Objects on something that no image shows: a bowl on a mug that it hides.

The prior lets an upright object stand on the plane, so that such a bowl becomes one on a high foot. None of
its measured points is near the plane, and where its height is free it explains the depth far better; or it
explains it better, and the shape on the plane is far from its class. Where something nearer to the camera
cuts it off below, that says nothing of where its base is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from perception.errors import PerceptionError
from perception.geometry import invert, transform_points
from perception.inference.acceptance import AcceptanceModel
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.inference.pose_choice import misfit
from perception.inference.scored_fits import ScoredFit, scored_fit
from perception.inference.shape_model import Decoder
from perception.inference.stack_choice import has_unlikely_shape
from perception.inference.stacking import BELOW, FREE, MeasuredExtent, raised
from perception.types import ObjectEstimate, SupportPlane

LEAST_BASE = 0.03  # [m] above the plane, of the lowest measured points and of the shape at any height
# Misfit on the plane: 0.2 and more for 20 objects on hidden supports, up to 0.1 for bottles on the table.
POOR = 0.15
# Largest misfit at any height relative to that of the same class on the plane: where the fit on the plane is
# poor, where moreover it alone does not converge, and where it is not poor.
CLEARLY, CONVERGED, FAR_BETTER = 0.65, 0.85, 0.2
GAIN = 0.05  # least difference of the two misfits
MOST = 0.25  # of its misfit
CUT_OFF = (
    0.2  # share of the lower edge at which something nearer may begin; 0.3 for cans behind other objects
)
_BESIDE = 0.01  # of the image width: distance from the edge at which the depth beside an object is looked at
_NEARER = 0.008  # [m] by which it is
_DOWN = 0.02  # [m] by which a point is moved to find the direction of the plane in an image


def on_hidden_supports(
    instances: Sequence[ObjectViews],
    estimates: Mapping[int, ObjectEstimate],
    planes: Mapping[int | None, SupportPlane],
    decoder: Decoder,
    model: AcceptanceModel,
    config: FitConfig = FitConfig(),
) -> dict[int, ObjectEstimate]:
    """Return estimates of the upright objects that do not stand on the plane, by id.

    Args:
        instances: Views of the objects that are examined.
        estimates: Estimates as objects on the plane, by id; rejected ones are missing.
        planes: Support plane of each object.
        decoder: Shape prior.
        model: Scores the evidence.
        config: Settings of the fits.
    """
    found = {}
    for views in instances:
        estimate = estimates.get(views.id)
        if estimate is not None and estimate.resting != "upright":
            continue
        named = views if estimate is None else replace(views, category=estimate.category)
        above = _above_plane(named, planes[views.id], decoder, model, config)
        if above is not None:
            found[views.id] = above
    return found


def _above_plane(
    views: ObjectViews, plane: SupportPlane, decoder: Decoder, model: AcceptanceModel, config: FitConfig
) -> ObjectEstimate | None:
    """Return the estimate of an object above the plane; None if it may stand on it."""
    base = MeasuredExtent.of(views, plane).base
    if base < LEAST_BASE or cut_off(views, plane) > CUT_OFF:
        return None
    anywhere = replace(config, noise=replace(config.noise, support_sigma=FREE))
    above = _attempt(views, raised(plane, base - BELOW), decoder, model, anywhere)
    if above is None or above.estimate.status == "implausible" or misfit(above.evidence) > MOST:
        return None
    if plane.height_above(above.estimate.mesh_world.vertices).min() < LEAST_BASE:
        return None
    standing = _attempt(views, plane, decoder, model, config)
    if standing is None:
        return above.estimate
    on_plane, statuses = misfit(standing.evidence), (above.estimate.status, standing.estimate.status)
    if has_unlikely_shape(standing.estimate) and not has_unlikely_shape(above.estimate):
        return above.estimate if misfit(above.evidence) < on_plane else None
    if on_plane < POOR:
        most = FAR_BETTER
    else:
        most = CONVERGED if statuses == ("converged", "not_converged") else CLEARLY
    return above.estimate if misfit(above.evidence) < min(most * on_plane, on_plane - GAIN) else None


def cut_off(views: ObjectViews, plane: SupportPlane) -> float:
    """Return the share of an object's lower edge, in all views, at which something nearer begins."""
    nearer, total = 0, 0
    for seen in views.observations:
        depth, (du, dv) = seen.frame.depth, _down(seen, plane)
        v, u = np.nonzero(seen.mask & (depth > 0))
        inside = (v + dv >= 0) & (v + dv < depth.shape[0]) & (u + du >= 0) & (u + du < depth.shape[1])
        v, u = v[inside], u[inside]
        beside = depth[v + dv, u + du]
        is_edge = ~seen.mask[v + dv, u + du] & (beside > 0)
        nearer += int((beside[is_edge] < depth[v, u][is_edge] - _NEARER).sum())
        total += int(is_edge.sum())
    return nearer / max(total, 1)


def _down(seen: ObjectObservation, plane: SupportPlane) -> tuple[int, int]:
    """Return an offset in pixels towards the plane, from the middle of an object; none if it is not seen."""
    points = seen.points_world()
    if not len(points):
        return 0, 0
    ends = np.array([points.mean(axis=0), points.mean(axis=0) - _DOWN * plane.normal])
    x, y, z = transform_points(invert(seen.T_world_camera), ends).T
    camera = seen.frame.intrinsics
    along = np.array([np.diff(camera.fx * x / z)[0], np.diff(camera.fy * y / z)[0]])
    offset = _BESIDE * camera.width * along / max(float(np.linalg.norm(along)), 1e-9)
    return round(float(offset[0])), round(float(offset[1]))


def _attempt(
    views: ObjectViews, plane: SupportPlane, decoder: Decoder, model: AcceptanceModel, config: FitConfig
) -> ScoredFit | None:
    try:
        return scored_fit(views, decoder, plane, model, config)
    except PerceptionError:
        return None
