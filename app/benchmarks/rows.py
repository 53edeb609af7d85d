"""The rows of the speed table, in the order of the pipeline."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from skimage import measure

from app.benchmarks.reference import (
    gradient_step,
    plain_decoder,
    plain_jacobian_rows,
    plain_render,
)
from app.benchmarks.scene import BenchScene, as_captured, square_view
from app.benchmarks.timing import Benchmark, Job
from perception.inference.fit import fit_object
from perception.inference.fit_config import FitConfig
from perception.inference.levenberg_marquardt import Evaluation, LmConfig, minimise
from perception.inference.meshing import mesh_from_grid
from perception.inference.observation import Crop, ObjectObservation, ObjectViews, gather_pixels
from perception.inference.optimisation import FitStart, optimise_object
from perception.inference.problem import FitProblem, FitState
from perception.inference.reconstruct import ReconstructOptions, reconstruct
from perception.inference.shape_model import SKIP_JACOBIAN, SKIP_OCCUPANCY, mean_shape
from perception.pipeline import detect
from perception.rendering.renderer import RayBundle, ShapeGrid, render
from perception.shape.decoder import ShapeDecoder
from perception.shape.weights import load_weights
from perception.types import CODE_SIZE

FIT_ITERATIONS = 30
AUTOGRAD_ROWS = 16  # timed rows of the autograd Jacobian, extrapolated to all rays
FIT_CROP = 64
SCAN_VIEWS = 5


def benchmarks(scene: BenchScene, device: str, seed: int) -> Iterator[Benchmark]:
    """Yield all rows; those on CUDA only where it is available."""
    yield from _rendering(scene.decoder)
    yield from _decoding(scene.decoder)
    yield from _fitting(scene, seed)
    yield from _scanning(scene)
    if importlib.util.find_spec("gymnasium") is not None:
        from app.benchmarks.environments import environment_rows

        yield from environment_rows(seed)
    if device == "cuda":
        yield from _on_cuda(scene.decoder)


def _rendering(decoder: ShapeDecoder) -> Iterator[Benchmark]:
    rays, A = square_view()
    grid, jacobian = _mean_mug(decoder)
    shape = _uploaded(grid, jacobian, "cpu")
    plain_grid, plain_A = torch.from_numpy(grid), torch.from_numpy(A).float()
    yield Benchmark(
        "render 64² × 50",
        "plain torch renderer",
        lambda: render(shape, rays, A, gradients=False),
        lambda: plain_render(plain_grid, rays, plain_A),
    )
    few = np.linspace(0, len(rays.directions) - 1, AUTOGRAD_ROWS).astype(int)
    sparse = RayBundle(rays.directions[few], rays.view[few], rays.depth_range, rays.samples)
    yield Benchmark(
        "render + variance + Jacobian, 64² × 50",
        f"plain torch with autograd, from {AUTOGRAD_ROWS} of 4096 rows",
        lambda: render(shape, rays, A),
        plain_jacobian_rows(grid, jacobian, sparse, A),
        reference_scale=len(rays.directions) / AUTOGRAD_ROWS,
    )


def _decoding(decoder: ShapeDecoder) -> Iterator[Benchmark]:
    code, plain_code = np.zeros(CODE_SIZE), torch.zeros(CODE_SIZE)
    plain = plain_decoder(load_weights(), "mug")

    @torch.no_grad()
    def decode_plain() -> torch.Tensor:
        return plain(plain_code[None])

    yield Benchmark(
        "decode one code",
        "plain torch layers",
        lambda: decoder("mug", code),
        decode_plain,
    )
    yield Benchmark(
        "decoder Jacobian",
        "torch.func.jacfwd, plain layers",
        lambda: decoder.with_jacobian("mug", code),
        lambda: torch.func.jacfwd(lambda c: plain(c[None])[0])(plain_code),
    )


def _fitting(scene: BenchScene, seed: int) -> Iterator[Benchmark]:
    one, three = (replace(scene.subject, observations=scene.subject.observations[:n]) for n in (1, 3))
    n_three = len(three.observations)
    iterate, descend = _iteration(scene, one, seed)
    yield Benchmark(
        f"LM iteration, one view, {FIT_CROP}² crop",
        "one gradient by autograd, plain torch",
        iterate,
        descend,
    )
    iterate_three, _ = _iteration(scene, three, seed)
    yield Benchmark(f"LM iteration, {n_three} views", "one view", iterate_three, iterate)
    cores = os.cpu_count() or 1
    for name, views in (("one view", one), (f"{n_three} views", three)):
        yield Benchmark(
            f"{FIT_ITERATIONS} iterations, {name}",
            f"{FIT_ITERATIONS} gradients of one view by autograd, plain torch",
            _fit(scene, views, 1, optimise_object),
            descend,
            reference_scale=FIT_ITERATIONS,
            expensive=True,
        )
        for what, fit in (
            (f"{FIT_ITERATIONS} iterations, {name}", optimise_object),
            (f"fit, {name}, with mesh and deviations", fit_object),
        ):
            yield Benchmark(
                f"{what}, {cores} cores",
                "one core",
                _fit(scene, views, cores, fit),
                _fit(scene, views, 1, fit),
                expensive=True,
            )


def _scanning(scene: BenchScene) -> Iterator[Benchmark]:
    grid, scale = scene.decoder("mug", np.zeros(CODE_SIZE)), np.full(3, 0.05)
    yield Benchmark(
        "mesh from a grid",
        "marching cubes alone",
        lambda: mesh_from_grid(grid, scale, "mug"),
        lambda: measure.marching_cubes(grid, 0.5),
    )
    frames, found, cores = scene.frames, scene.detections, os.cpu_count() or 1
    yield Benchmark(
        f"detect the objects of a frame, {cores} cores",
        "one core",
        lambda: detect(as_captured(frames), scene.detector),
        lambda: detect(as_captured(frames), scene.detector, workers=1),
        scale=1 / len(frames),
        reference_scale=1 / len(frames),
        expensive=True,
    )
    views, masks = frames[:SCAN_VIEWS], found.per_frame[:SCAN_VIEWS]
    decoder, plane, alone = scene.decoder, found.plane, ReconstructOptions(workers=1)
    yield Benchmark(
        f"reconstruct {found.n_objects} objects from {len(views)} views, {cores} cores",
        "one core",
        lambda: reconstruct(as_captured(views), masks, decoder, plane),
        lambda: reconstruct(as_captured(views), masks, decoder, plane, options=alone),
        expensive=True,
    )


def _on_cuda(decoder: ShapeDecoder) -> Iterator[Benchmark]:
    rays, A = square_view()
    grid, jacobian = _mean_mug(decoder)
    on_cpu, on_cuda = (_uploaded(grid, jacobian, device) for device in ("cpu", "cuda:0"))
    yield Benchmark(
        "CUDA: render + variance + Jacobian, 64² × 50",
        "one core",
        lambda: render(on_cuda, rays, A),
        lambda: render(on_cpu, rays, A),
    )
    host, code = ShapeDecoder.load(), np.zeros(CODE_SIZE)
    yield Benchmark(
        "CUDA: decoder Jacobian",
        "one core",
        lambda: decoder.with_jacobian("mug", code),
        lambda: host.with_jacobian("mug", code),
    )


def _mean_mug(decoder: ShapeDecoder) -> tuple[np.ndarray, np.ndarray]:
    return decoder.with_jacobian("mug", np.zeros(CODE_SIZE))


def _uploaded(grid: np.ndarray, jacobian: np.ndarray, device: str) -> ShapeGrid:
    return ShapeGrid.upload(grid, jacobian, device, SKIP_OCCUPANCY, SKIP_JACOBIAN)


def _fit(scene: BenchScene, views: ObjectViews, threads: int, fit: Callable[..., object]) -> Job:
    """Return a fit of the product's schedule from one yaw that never stops early; the mesh is not refined."""
    certain = tuple(replace(seen, yaw_probabilities=_certain(seen)) for seen in views.observations)
    known = replace(views, observations=certain)
    config = FitConfig()
    config = replace(config, lm=replace(config.lm, tolerance=-1.0), threads=threads, refine=None)
    return lambda: fit(known, scene.decoder, scene.detections.plane, config)


def _certain(seen: ObjectObservation) -> np.ndarray:
    """Return a yaw distribution with all probability in its most probable bin."""
    p = seen.yaw_probabilities
    return np.eye(len(p))[p.argmax()] if p.size else p


def _iteration(scene: BenchScene, views: ObjectViews, seed: int) -> tuple[Job, Job]:
    """Return one LM iteration without relinearisation, and one gradient of the same cost by autograd."""
    config, category = FitConfig(), views.category
    start = FitStart.of(views, scene.detections.plane, config)
    pixels = gather_pixels(views.observations, start.sampling, Crop(FIT_CROP), config.pixels)
    shape = mean_shape(scene.decoder, category)
    problem = FitProblem(pixels, shape, start.support, config.noise)
    code = 0.1 * np.random.default_rng(seed).standard_normal(CODE_SIZE)
    state = FitState(start.poses[0], code)
    once, current = LmConfig(max_iterations=1, damping=1.0), problem(state)

    def evaluate(at: FitState) -> Evaluation:
        return current if at is state else problem(at)  # known from the previous iteration

    return (
        lambda: minimise(evaluate, FitState.moved, state, once),
        gradient_step(load_weights().decoder, category, pixels, state, config.noise),
    )
