"""Joint optimisation of a few keyframes: camera poses, object poses and shape codes together.

NodeSLAM, section "Sliding-Window Joint Optimisation". The first camera stands still. Objects meet only
through the cameras, so with c the cameras' step and o_i each object's, the damped normal equations

    [H_cc  H_co] [c]     [g_c]
    [H_oc  H_oo] [o] = - [g_o],      H_oo block diagonal, 25 x 25 for each object,

are solved by Schur complement: (H_cc - sum H_ci H_ii^-1 H_ic) c = -(g_c - sum H_ci H_ii^-1 g_i), and then
each object's step by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from perception.geometry import invert, se3_exp, se3_log
from perception.inference.levenberg_marquardt import Evaluation, LmConfig
from perception.inference.observation import Crop, PixelConfig, PixelSet, SamplingRange, gather_pixels
from perception.inference.problem import (
    PARAMETERS,
    FitProblem,
    FitState,
    NoiseConfig,
    StepLimits,
    SupportCamera,
)
from perception.inference.shape_model import Decoder, LinearisedShape, linearise
from perception.rendering.pose import object_by_camera
from perception.slam.keyframes import Keyframe
from perception.slam.landmarks import Landmark
from perception.slam.marginal_prior import Memory, View
from perception.types import CODE_SIZE, GRID_RESOLUTION, SupportPlane

CAMERA = 6


@dataclass(frozen=True)
class JointConfig:
    """How a window is optimised.

    Attributes:
        window: keyframes together.
        crop: pixels along the longer side of each object's crop.
        iterations: of Levenberg-Marquardt.
        support_pixels: along a side of the image that an object's foot is seen in from below.
        relinearise: decode a shape anew when its code has moved this far.
        lm: damping.
        noise: weights of the residuals.
        pixels: which pixels take part.
        step_limits: of the objects in one iteration; the cameras' steps are shortened with them.
        memory: so many views' worth of what earlier keyframes, outside the window, said of an object counts.
        camera_weight: of what was known of each camera's pose when its keyframe was taken; the data counts by
            so much more here than it did then.
        camera_sigma: of those keyframes' cameras (rotation, translation), unless they were known better when
            they were taken, as the first one was [rad], [m].
        plane_sigma: of a point of the plane [m]; the plane ties cameras only where ``use_plane``.
        use_plane: whether it does.
        threads: objects evaluated at a time.
    """

    window: int = 3
    crop: int = 24
    support_pixels: int = 8
    iterations: int = 6
    relinearise: float = 1.5
    lm: LmConfig = field(default_factory=lambda: LmConfig(damping=1e-2))
    noise: NoiseConfig = field(default_factory=lambda: NoiseConfig(data_weight=0.2))
    pixels: PixelConfig = field(default_factory=PixelConfig)
    memory: float = 4.0
    step_limits: StepLimits = field(default_factory=StepLimits)
    camera_weight: float = 4.0
    camera_sigma: Float[np.ndarray, "6"] = field(default_factory=lambda: np.repeat([0.005, 0.003], 3))
    plane_sigma: float = 0.005
    use_plane: bool = True
    threads: int = 2


@dataclass(frozen=True)
class JointResult:
    """The window afterwards: keyframes and landmarks moved, costs before and after.

    ``views`` is what each keyframe, by its number, said of each landmark.
    """

    keyframes: tuple[Keyframe, ...]
    landmarks: Mapping[int, Landmark]
    views: Mapping[tuple[int, int], View]
    cost_before: float
    cost_after: float
    iterations: int


@dataclass(frozen=True)
class NormalEquations:
    """Of one window: cameras (c = 6 each, the first left out), objects (25 each), and what ties them."""

    cameras: Float[np.ndarray, "c c"]
    objects: Float[np.ndarray, "o 25 25"]
    ties: Float[np.ndarray, "o 25 c"]
    gradient_cameras: Float[np.ndarray, "c"]
    gradient_objects: Float[np.ndarray, "o 25"]


def solve_by_schur(
    equations: NormalEquations, damping: float
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "o 25"]]:
    """Steps of cameras and objects of the damped equations; see the head of the file."""
    cameras, objects = (_damped(H, damping) for H in (equations.cameras, equations.objects))
    right = np.concatenate([equations.ties, equations.gradient_objects[..., None]], axis=-1)
    solved = np.linalg.solve(objects, right) if len(objects) else right
    A, b = solved[..., :-1], solved[..., -1]  # H_ii^-1 H_ic, H_ii^-1 g_i
    reduced = cameras - np.einsum("oic,oid->cd", equations.ties, A)
    rest = equations.gradient_cameras - np.einsum("oic,oi->c", equations.ties, b)
    step = -np.linalg.solve(reduced, rest) if len(rest) else -rest
    return step, -b - A @ step


def _damped(H: np.ndarray, damping: float) -> np.ndarray:
    diagonal = np.diagonal(H, axis1=-2, axis2=-1)
    floor = 1e-9 * np.maximum(diagonal.max(axis=-1, keepdims=True, initial=0.0), 1e-12)
    return H + np.eye(H.shape[-1]) * (damping * diagonal + floor)[..., None, :]


def optimise_jointly(
    keyframes: Sequence[Keyframe],
    landmarks: Mapping[int, Landmark],
    decoder: Decoder,
    plane: SupportPlane,
    plane_points: Sequence[Float[np.ndarray, "_n 3"]],
    config: JointConfig,
    known: Mapping[int, Memory] | None = None,
) -> JointResult:
    """Moves the cameras of all keyframes but the first, and the landmarks that they see.

    Args:
        keyframes: the window, the one that stands still first.
        landmarks: of the map; others than those seen stay as they are.
        decoder: the shape prior.
        plane: what the objects stand on.
        plane_points: for each keyframe points of the plane in its camera's frame [m].
        config: weights and budgets.
        known: of landmarks from elsewhere. Without it an object that the window shows little of, as the image
            cuts it, would forget what was seen of it before.
    """
    window = _Window(keyframes, landmarks, decoder, plane, plane_points, config, known or {})
    with ThreadPoolExecutor(config.threads) as pool:
        return window.run(pool)


class _ObjectInWindow:
    """One object's pixels in all views of the window, and the least-squares problem they make."""

    def __init__(self, landmark: Landmark, views: list[int], window: _Window) -> None:
        self.landmark, self.views = landmark, views
        config, pose = window.config, landmark.state.pose
        voxel = 2 * float(pose.scale.max()) / GRID_RESOLUTION
        sampling = SamplingRange.around(pose.translation, landmark.reach, landmark.step * voxel)
        observations = [window.keyframes[k].observation(landmark.id) for k in views]
        self.pixels = gather_pixels(observations, sampling, Crop(config.crop), config.pixels)
        self.noise = config.noise
        lowest = pose.scale.max()
        height = max(2 * pose.scale[2], 0.04)
        self.support = SupportCamera.under(pose, window.plane, lowest, height, config.support_pixels)

    def evaluate(
        self, state: FitState, landmark: Landmark, Ts_world_camera: np.ndarray
    ) -> tuple[Evaluation, np.ndarray]:
        """Rows by the object's parameters, and the render rows' derivatives by their own camera (n, 6)."""
        Ts = Ts_world_camera[self.views]
        pixels: PixelSet = replace(self.pixels, Ts_world_camera=Ts)
        evaluation = FitProblem(pixels, landmark.shape, self.support, self.noise)(state)
        n = len(pixels.target)
        rows = evaluation.jacobian[:n, CODE_SIZE:]
        camera = np.empty((n, CAMERA))
        for k, T in enumerate(Ts):
            own = pixels.rays.view == k
            camera[own] = rows[own, :CAMERA] @ object_by_camera(state.pose, T)
        return evaluation, camera


class _Window:
    """The state of a joint optimisation and its steps."""

    def __init__(
        self, keyframes, landmarks, decoder, plane, plane_points, config: JointConfig, known
    ) -> None:
        self.known: Mapping[int, Memory] = known
        self.keyframes, self.decoder, self.plane, self.config = list(keyframes), decoder, plane, config
        self.plane_points = plane_points
        self.Ts = np.stack([k.T_world_camera for k in keyframes])
        ids = sorted(set().union(*(k.landmarks for k in keyframes)) & set(landmarks))
        self.landmarks: dict[int, Landmark] = {one: landmarks[one] for one in ids}
        views = {one: [k for k, key in enumerate(keyframes) if one in key.landmarks] for one in ids}
        self.objects = {one: _ObjectInWindow(landmarks[one], views[one], self) for one in ids}
        self.states = {one: landmarks[one].state for one in ids}
        self.start = dict(self.states)
        self.free = CAMERA * (len(keyframes) - 1)
        self.Ts_start = self.Ts.copy()
        self.known_cameras = [config.camera_weight * np.linalg.inv(k.covariance) for k in keyframes[1:]]

    def run(self, pool: ThreadPoolExecutor) -> JointResult:
        config, damping, small = self.config, self.config.lm.damping, 0
        self._refresh_shapes(pool, force=True)
        current = self._evaluate(pool, self.states, self.Ts)
        before = after = self._cost(current, current) + self._cost_of_known(self.states, self.Ts)
        done = 0
        for _ in range(config.iterations):
            step_c, step_o = solve_by_schur(self._equations(current), damping)
            if not (np.isfinite(step_c).all() and np.isfinite(step_o).all()):
                break
            states, Ts = self._moved(step_c, step_o)
            there = self._evaluate(pool, states, Ts)
            done += 1
            cost = self._cost(current, current) + self._cost_of_known(self.states, self.Ts)
            cost_after = self._cost(there, current) + self._cost_of_known(states, Ts)
            if cost_after >= cost:
                damping *= config.lm.up
                continue
            self.states, self.Ts, damping, after = states, Ts, damping * config.lm.down, cost_after
            small = small + 1 if cost - cost_after < 1e-4 * cost else 0
            current = there
            if small == 2:
                break
            if self._refresh_shapes(pool):
                current = self._evaluate(pool, states, Ts)
        return self._result(before, after, done, current)

    def _evaluate(self, pool: ThreadPoolExecutor, states, Ts) -> dict[str, list]:
        """Evaluations of all objects, then plane rows of the free cameras."""
        ids = list(self.objects)
        jobs = [pool.submit(self.objects[i].evaluate, states[i], self.landmarks[i], Ts) for i in ids]
        objects = [job.result() for job in jobs]
        planes = [self._plane_rows(T, points) for T, points in zip(Ts, self.plane_points)]
        return {"objects": objects, "planes": planes if self.config.use_plane else []}

    def _plane_rows(self, T: np.ndarray, points: np.ndarray) -> Evaluation:
        config = self.config
        normal = T[:3, :3].T @ self.plane.normal
        residual = points @ normal + T[:3, 3] @ self.plane.normal - self.plane.offset
        jacobian = np.concatenate([np.cross(points, normal), np.broadcast_to(normal, points.shape)], axis=1)
        robust = np.minimum(1.0, 3 * config.plane_sigma / np.maximum(np.abs(residual), 1e-9))
        return Evaluation(residual, jacobian, config.noise.data_weight * robust / config.plane_sigma**2)

    def _cost(self, at: dict[str, list], weights_of: dict[str, list]) -> float:
        """Weighted squares of the residuals at one place with the weights of another."""
        total = 0.0
        for (here, _), (there, _) in zip(at["objects"], weights_of["objects"]):
            total += float(there.weights @ here.residuals.astype(np.float64) ** 2)
        for here, there in zip(at["planes"], weights_of["planes"]):
            total += float(there.weights @ here.residuals**2)
        return total

    def _cost_of_known(self, states: Mapping[int, FitState], Ts: np.ndarray) -> float:
        """What it costs that landmarks and cameras are elsewhere than what is known of them says."""
        steps = {one: states[one].step_from(self.start[one]) for one in self.known if one in states}
        landmarks = sum(self.known[one].cost_of(step) for one, step in steps.items())
        cameras = sum(xi @ known @ xi for xi, known in zip(self._camera_steps(Ts), self.known_cameras))
        return float(landmarks + cameras)

    def _camera_steps(self, Ts: np.ndarray) -> list[np.ndarray]:
        """How far each camera but the first is from where it started."""
        return [se3_log(invert(start) @ T) for start, T in zip(self.Ts_start[1:], Ts[1:])]

    def _equations(self, current: dict[str, list]) -> NormalEquations:
        n = len(self.objects)
        cameras, gradient = np.zeros((self.free, self.free)), np.zeros(self.free)
        objects, ties = np.zeros((n, PARAMETERS, PARAMETERS)), np.zeros((n, PARAMETERS, self.free))
        gradient_objects = np.zeros((n, PARAMETERS))
        for i, (one, (evaluation, by_camera)) in enumerate(zip(self.objects, current["objects"])):
            item = self.objects[one]
            objects[i], gradient_objects[i] = evaluation.normal_equations()
            if one in self.known:
                objects[i] += self.known[one].information
                gradient_objects[i] += self.known[one].gradient(self.states[one].step_from(self.start[one]))
            rows = len(by_camera)
            for k, camera in enumerate(item.views):
                if camera == 0:
                    continue
                own, at = item.pixels.rays.view == k, slice(CAMERA * (camera - 1), CAMERA * camera)
                weights, J_c = evaluation.weights[:rows][own], by_camera[own]
                weighted = J_c * weights[:, None]
                cameras[at, at] += weighted.T @ J_c
                gradient[at] += weighted.T @ evaluation.residuals[:rows][own]
                ties[i][:, at] = evaluation.jacobian[:rows][own].T @ weighted
        for camera, (xi, known) in enumerate(zip(self._camera_steps(self.Ts), self.known_cameras)):
            at = slice(CAMERA * camera, CAMERA * (camera + 1))
            cameras[at, at] += known
            gradient[at] += known @ xi
        for camera, plane in enumerate(current["planes"][1:]):
            at = slice(CAMERA * camera, CAMERA * (camera + 1))
            hessian, g = plane.normal_equations()
            cameras[at, at] += hessian
            gradient[at] += g
        return NormalEquations(cameras, objects, ties, gradient, gradient_objects)

    def _moved(self, step_c: np.ndarray, step_o: np.ndarray) -> tuple[dict[int, FitState], np.ndarray]:
        limits = self.config.step_limits.vector
        shrink = max(1.0, float(np.max(np.abs(step_o) / limits, initial=0.0)))
        states = {one: self.states[one].moved(step / shrink) for one, step in zip(self.objects, step_o)}
        Ts = self.Ts.copy()
        for k, xi in enumerate(step_c.reshape(-1, CAMERA), start=1):
            Ts[k] = Ts[k] @ se3_exp(xi / shrink)
        return states, Ts

    def _refresh_shapes(self, pool: ThreadPoolExecutor, force: bool = False) -> bool:
        """Decodes the shapes whose codes have moved far; with ``force`` all that are not near."""
        least = 0.3 * self.config.relinearise if force else self.config.relinearise
        far = [
            one
            for one, state in self.states.items()
            if np.linalg.norm(state.code - self.landmarks[one].shape.code) > least
        ]

        def decoded(one: int) -> LinearisedShape:
            return linearise(self.decoder, self.landmarks[one].category, self.states[one].code)

        for one, shape in zip(far, pool.map(decoded, far)):
            self.landmarks[one] = replace(self.landmarks[one], shape=shape)
        return bool(far)

    def _result(self, before: float, after: float, done: int, current: dict[str, list]) -> JointResult:
        views = {
            (self.keyframes[camera].number, one): View(self.states[one], self._said(item, k, *at))
            for (one, item), at in zip(self.objects.items(), current["objects"])
            for k, camera in enumerate(item.views)
        }
        landmarks = {}
        for one, state in self.states.items():
            landmark = self.landmarks[one].with_state(state)
            landmarks[one] = replace(landmark, updates=landmark.updates + 1)
        keyframes = tuple(k.moved(T) for k, T in zip(self.keyframes, self.Ts))
        return JointResult(keyframes, landmarks, views, before, after, done)

    def _said(
        self, item: _ObjectInWindow, k: int, evaluation: Evaluation, by_camera: np.ndarray
    ) -> Float[np.ndarray, "25 25"]:
        """Information on a landmark from its view k, the doubt about that view's camera taken out."""
        own = np.flatnonzero(item.pixels.rays.view == k)
        J, weights, J_c = (
            evaluation.jacobian[own].astype(np.float64),
            evaluation.weights[own, None],
            by_camera[own],
        )
        ties = J.T @ (weights * J_c)
        held = np.diag(self.config.camera_sigma**-2) + np.linalg.inv(self.keyframes[item.views[k]].covariance)
        return J.T @ (weights * J) - ties @ np.linalg.solve(J_c.T @ (weights * J_c) + held, ties.T)
