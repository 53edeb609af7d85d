"""Reconstruction of one object: optimised pose and code, mesh, covariance and status."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from perception.errors import PerceptionError
from perception.geometry import invert
from perception.inference.contents import VESSELS, without_contents
from perception.inference.fit_config import FitConfig
from perception.inference.initialise import plane_basis
from perception.inference.meshing import mesh_from_grid
from perception.inference.observation import ObjectViews
from perception.inference.optimisation import Fit, OnStep, optimise_object
from perception.inference.refine import refine_mesh
from perception.inference.resting import tilt_error
from perception.inference.shape_model import Decoder
from perception.inference.uncertainty import calibrated_deviation
from perception.types import FitStatus, ObjectEstimate, SupportPlane


class FitFailedError(PerceptionError):
    """The fit of one object has no usable result."""


def fit_object(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig = FitConfig(),
    on_step: OnStep | None = None,
) -> ObjectEstimate:
    """Reconstruct one object; see ``fit_with_grid``."""
    return fit_with_grid(views, decoder, plane, config, on_step)[0]


def fit_with_grid(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    config: FitConfig = FitConfig(),
    on_step: OnStep | None = None,
) -> tuple[ObjectEstimate, Float[np.ndarray, "r r r"]]:
    """Reconstruct one object; return the estimate and the occupancies of its code.

    Args:
        views: Observations of the object, at least one, with its class.
        decoder: Shape prior.
        plane: Support plane of the object, in the world frame.
        config: Budget and weights.
        on_step: Called with the progress of the fit.

    Raises:
        InvalidInputError: No view is given, or none shows any point of the object above the plane.
        FitFailedError: The numerics failed, or no measurement agrees with the result.
    """
    try:
        if views.category in VESSELS and config.resting == "upright":
            basis = plane_basis(plane)
            seen = without_contents(views.observations, views.category, plane, basis)
            views = replace(views, observations=seen)
        fit = optimise_object(views, decoder, plane, config, on_step)
        estimate, grid = _estimate(fit, views, decoder, plane, config)
    except PerceptionError:
        raise
    except Exception as error:  # numpy, scipy, scikit-image and trimesh raise many types on degenerate input
        raise FitFailedError(f"the fit failed ({type(error).__name__}: {error})") from error
    check_finite(estimate)
    return estimate, grid


def check_finite(estimate: ObjectEstimate) -> None:
    """Raise FitFailedError, which names the field, if a number of an estimate is NaN or infinite."""
    fields = {
        "residual": estimate.residual,
        "score": estimate.score,
        "pose": estimate.T_world_object,
        "scale": estimate.scale,
        "code": estimate.code,
        "mesh": estimate.mesh.vertices,
        "surface deviations": () if estimate.surface_sigma is None else estimate.surface_sigma,
        "covariance": () if estimate.covariance is None else estimate.covariance,
    }
    bad = [name for name, value in fields.items() if not np.isfinite(value).all()]
    if bad:
        raise FitFailedError(f"its {' and '.join(bad)} {'is' if len(bad) == 1 else 'are'} not finite")


def _estimate(
    fit: Fit, views: ObjectViews, decoder: Decoder, plane: SupportPlane, config: FitConfig
) -> tuple[ObjectEstimate, Float[np.ndarray, "r r r"]]:
    """Mesh a fit, refine the mesh on the measurements and predict its deviations; also return the grid."""
    pose, code, category = fit.state.pose, fit.state.code, views.category
    grid, jacobian = decoder.with_jacobian(category, code, config.threads)
    mesh = mesh_from_grid(grid, pose.scale, category, config.mesh)
    determined = np.zeros(len(mesh.vertices))
    if config.refine is not None:
        in_world = mesh.transformed(pose.T_world_object)
        # The prior knows bottles with corners; cans are round, and the handles of mugs follow no harmonics.
        sections = pose.T_world_object if category == "bowl" else None
        refined = refine_mesh(in_world, views.observations, plane, config.refine, sections)
        mesh, determined = refined.mesh.transformed(invert(pose.T_world_object)), refined.determined
    hessian, _ = fit.evaluation.normal_equations()
    inliers = np.abs(fit.residual_object) < config.noise.huber * config.noise.depth_sigma
    if not inliers.any():
        raise FitFailedError("no measured depth agrees with the fitted shape")
    residual = float(np.sqrt(np.mean(fit.residual_object[inliers] ** 2)))
    covariance = np.linalg.pinv(hessian, hermitian=True)
    estimate = ObjectEstimate(
        id=views.id,
        category=category,
        code=code,
        T_world_object=pose.T_world_object,
        scale=pose.scale,
        mesh=mesh,
        score=views.score,
        n_views=len(views.observations),
        residual=residual,
        status=_status(fit, plane, float(inliers.mean()), config),
        covariance=covariance,
        resting=config.resting,
    )
    sigma = calibrated_deviation(estimate, covariance, determined, grid, jacobian)
    return replace(estimate, surface_sigma=sigma), grid


def _status(fit: Fit, plane: SupportPlane, inlier_ratio: float, config: FitConfig) -> FitStatus:
    """Return whether the fit converged to a plausible object: inliers, size, code, tilt."""
    pose = fit.state.pose
    plausible = (
        inlier_ratio > 0.5
        and pose.scale.min() > 0.01
        and pose.scale.max() < 0.4
        and np.linalg.norm(fit.state.code) < 8.0
        and tilt_error(pose.rotation, plane, config.resting) < config.max_tilt
        and np.isfinite(fit.evaluation.cost)
    )
    if not plausible:
        return "implausible"
    return "converged" if fit.converged else "not_converged"
