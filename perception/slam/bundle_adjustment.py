"""Joint optimisation: sliding-window bundle adjustment of camera poses, object poses and shape codes.

NodeSLAM, section "Sliding-Window Joint Optimisation". Levenberg-Marquardt on the depth residuals of a few
keyframes, solved by the Schur complement (``schur.py``). The first keyframe is fixed.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from perception.geometry import invert, se3_exp, se3_log
from perception.inference.problem import PARAMETERS
from perception.inference.shape_model import Decoder, LinearisedShape, linearise
from perception.slam.bundle_residuals import (
    CAMERA_SIZE,
    ObjectEvaluation,
    ObjectInWindow,
    WindowEvaluation,
    WindowState,
)
from perception.slam.bundle_window import BundleAdjustmentConfig, BundleResult, BundleWindow
from perception.slam.marginal_prior import ViewInformation
from perception.slam.plane_factor import PlaneNoise, evaluate_plane
from perception.slam.schur import NormalEquations, solve_by_schur

_FIRST_RELINEARISATION = 0.3  # share of ``relinearise_distance`` that counts before the first iteration
_SMALL_DECREASE = 1e-4  # relative decrease of the cost that counts as converged, twice in all


def optimise_jointly(
    window: BundleWindow, decoder: Decoder, config: BundleAdjustmentConfig = BundleAdjustmentConfig()
) -> BundleResult:
    """Optimise the observed landmarks and the cameras of all keyframes but the first.

    Args:
        window: Keyframes, landmarks and priors.
        decoder: Shape prior.
        config: Budget and weights.
    """
    with ThreadPoolExecutor(config.threads) as pool:
        return _Optimiser(window, decoder, config, pool).run()


class _Optimiser:
    """Levenberg-Marquardt on one window.

    Attributes:
        state: Present parameters; ``start`` are those at the beginning.
        shapes: Linearised decoder of each object.
    """

    def __init__(
        self,
        window: BundleWindow,
        decoder: Decoder,
        config: BundleAdjustmentConfig,
        pool: ThreadPoolExecutor,
    ) -> None:
        self.window, self.decoder, self.config, self.pool = window, decoder, config, pool
        keyframes, landmarks = window.keyframes, window.landmarks
        observed = set().union(*(key.landmark_ids for key in keyframes)) & set(landmarks)
        self.objects: dict[int, ObjectInWindow] = {}
        for id in sorted(observed):
            views = [k for k, key in enumerate(keyframes) if id in key.landmark_ids]
            self.objects[id] = ObjectInWindow(landmarks[id], views, window, config)
        self.shapes: dict[int, LinearisedShape] = {id: landmarks[id].shape for id in self.objects}
        Ts = np.stack([key.T_world_camera for key in keyframes])
        self.start = self.state = WindowState({id: landmarks[id].state for id in self.objects}, Ts)
        self.camera_priors = [
            config.camera_prior_weight * np.linalg.inv(key.covariance) for key in keyframes[1:]
        ]
        self.plane_noise = PlaneNoise(config.plane_sigma, config.noise.huber, config.noise.data_weight)

    def run(self) -> BundleResult:
        """Iterate until convergence or the end of the budget."""
        lm, damping, n_small = self.config.lm, self.config.lm.damping, 0
        self._relinearise(_FIRST_RELINEARISATION * self.config.relinearise_distance)
        current = self._evaluate(self.state)
        cost_before = cost_after = self._cost(current, current) + self._prior_cost(self.state)
        iterations = 0
        for _ in range(self.config.max_iterations):
            camera_step, object_steps = solve_by_schur(self._normal_equations(current), damping)
            if not (np.isfinite(camera_step).all() and np.isfinite(object_steps).all()):
                break
            candidate = self._moved(camera_step, object_steps)
            there = self._evaluate(candidate)
            iterations += 1
            cost = self._cost(current, current) + self._prior_cost(self.state)
            candidate_cost = self._cost(there, current) + self._prior_cost(candidate)
            if candidate_cost >= cost:
                damping *= lm.up
                continue
            self.state, damping, cost_after, current = candidate, damping * lm.down, candidate_cost, there
            n_small = n_small + 1 if cost - candidate_cost < _SMALL_DECREASE * cost else 0
            if n_small == 2:
                break
            if self._relinearise(self.config.relinearise_distance):
                current = self._evaluate(self.state)
        return self._result(cost_before, cost_after, iterations, current)

    def _evaluate(self, state: WindowState) -> WindowEvaluation:
        Ts, plane = state.Ts_world_camera, self.window.plane
        jobs = [
            self.pool.submit(item.evaluate, state.objects[id], self.shapes[id], Ts)
            for id, item in self.objects.items()
        ]
        objects, planes = [job.result() for job in jobs], []
        if self.config.use_plane:
            points_of = zip(Ts, self.window.plane_points)
            planes = [evaluate_plane(T, points, plane, self.plane_noise) for T, points in points_of]
        return WindowEvaluation(objects, planes)

    def _cost(self, at: WindowEvaluation, weights_of: WindowEvaluation) -> float:
        """Return the sum of squared residuals at one state with the weights of another."""
        total = 0.0
        for here, there in zip(at.objects, weights_of.objects):
            total += float(there.problem.weights @ here.problem.residuals.astype(np.float64) ** 2)
        for here, there in zip(at.planes, weights_of.planes):
            total += float(there.weights @ here.residuals**2)
        return total

    def _prior_cost(self, state: WindowState) -> float:
        """Return the cost of the priors on landmarks and cameras."""
        landmarks = sum(
            prior.cost_at(state.objects[id].step_from(self.start.objects[id]))
            for id, prior in self.window.priors.items()
            if id in state.objects
        )
        steps = self._camera_steps(state)
        cameras = sum(xi @ information @ xi for xi, information in zip(steps, self.camera_priors))
        return float(landmarks + cameras)

    def _camera_steps(self, state: WindowState) -> list[np.ndarray]:
        """Return the step (6,) of each camera but the first from its start."""
        pairs = zip(self.start.Ts_world_camera[1:], state.Ts_world_camera[1:])
        return [se3_log(invert(start) @ T) for start, T in pairs]

    def _normal_equations(self, current: WindowEvaluation) -> NormalEquations:
        n, free = len(self.objects), CAMERA_SIZE * (len(self.window.keyframes) - 1)
        cameras, gradient = np.zeros((free, free)), np.zeros(free)
        objects, coupling = np.zeros((n, PARAMETERS, PARAMETERS)), np.zeros((n, PARAMETERS, free))
        gradient_objects = np.zeros((n, PARAMETERS))
        for i, ((id, item), evaluation) in enumerate(zip(self.objects.items(), current.objects)):
            problem, by_camera = evaluation.problem, evaluation.camera_jacobian
            objects[i], gradient_objects[i] = problem.normal_equations()
            if id in self.window.priors:
                prior = self.window.priors[id]
                objects[i] += prior.information
                step = self.state.objects[id].step_from(self.start.objects[id])
                gradient_objects[i] += prior.gradient_at(step)
            rows = len(by_camera)
            for k, camera in enumerate(item.views):
                if camera == 0:
                    continue
                own, at = item.pixels.rays.view == k, _columns(camera)
                weights, J_camera = problem.weights[:rows][own], by_camera[own]
                weighted = J_camera * weights[:, None]
                cameras[at, at] += weighted.T @ J_camera
                gradient[at] += weighted.T @ problem.residuals[:rows][own]
                coupling[i][:, at] = problem.jacobian[:rows][own].T @ weighted
        steps = self._camera_steps(self.state)
        for camera, (xi, information) in enumerate(zip(steps, self.camera_priors), start=1):
            at = _columns(camera)
            cameras[at, at] += information
            gradient[at] += information @ xi
        for camera, plane in enumerate(current.planes[1:], start=1):
            at = _columns(camera)
            hessian, plane_gradient = plane.normal_equations()
            cameras[at, at] += hessian
            gradient[at] += plane_gradient
        return NormalEquations(cameras, objects, coupling, gradient, gradient_objects)

    def _moved(
        self, camera_step: Float[np.ndarray, "c"], object_steps: Float[np.ndarray, "o 25"]
    ) -> WindowState:
        """Return the state after a step, which is shortened as a whole to the step limits."""
        limits = self.config.step_limits.vector
        shrink = max(1.0, float(np.max(np.abs(object_steps) / limits, initial=0.0)))
        pairs = zip(self.objects, object_steps)
        objects = {id: self.state.objects[id].moved(step / shrink) for id, step in pairs}
        Ts = self.state.Ts_world_camera.copy()
        for k, xi in enumerate(camera_step.reshape(-1, CAMERA_SIZE), start=1):
            Ts[k] = Ts[k] @ se3_exp(xi / shrink)
        return WindowState(objects, Ts)

    def _relinearise(self, distance: float) -> bool:
        """Decode the shapes whose codes are farther than ``distance`` from their linearisation."""
        far = [
            id
            for id, state in self.state.objects.items()
            if np.linalg.norm(state.code - self.shapes[id].code) > distance
        ]

        def decoded(id: int) -> LinearisedShape:
            category = self.window.landmarks[id].category
            return linearise(self.decoder, category, self.state.objects[id].code)

        self.shapes |= dict(zip(far, self.pool.map(decoded, far)))
        return bool(far)

    def _result(
        self, cost_before: float, cost_after: float, iterations: int, current: WindowEvaluation
    ) -> BundleResult:
        keyframes, states = self.window.keyframes, self.state.objects
        information = {
            (keyframes[camera].number, id): ViewInformation(
                states[id], self._view_information(item, k, evaluation)
            )
            for (id, item), evaluation in zip(self.objects.items(), current.objects)
            for k, camera in enumerate(item.views)
        }
        landmarks = {}
        for id, state in states.items():
            landmark = replace(self.window.landmarks[id], shape=self.shapes[id]).with_state(state)
            landmarks[id] = replace(landmark, n_updates=landmark.n_updates + 1)
        posed = tuple(key.with_pose(T) for key, T in zip(keyframes, self.state.Ts_world_camera))
        return BundleResult(posed, landmarks, information, cost_before, cost_after, iterations)

    def _view_information(
        self, item: ObjectInWindow, k: int, evaluation: ObjectEvaluation
    ) -> Float[np.ndarray, "25 25"]:
        """Return the information of view k on its object, with the camera pose marginalised out."""
        own = np.flatnonzero(item.pixels.rays.view == k)
        J = evaluation.problem.jacobian[own].astype(np.float64)
        weights, J_camera = evaluation.problem.weights[own, None], evaluation.camera_jacobian[own]
        coupling = J.T @ (weights * J_camera)
        covariance = self.window.keyframes[item.views[k]].covariance
        camera_prior = np.diag(self.config.camera_sigma**-2) + np.linalg.inv(covariance)
        camera = J_camera.T @ (weights * J_camera) + camera_prior
        return J.T @ (weights * J) - coupling @ np.linalg.solve(camera, coupling.T)


def _columns(camera: int) -> slice:
    """Return the columns of a free camera, counted from 1 as the first keyframe is fixed."""
    return slice(CAMERA_SIZE * (camera - 1), CAMERA_SIZE * camera)
