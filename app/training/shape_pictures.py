"""Figures of the shape prior's model card: reconstructions, interpolation, and derivatives of the renderer.

The derivative figures follow NodeSLAM: one rendered depth with respect to the occupancies, and a rendered
object with respect to its code.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from app.drawing import draw_estimates
from manipulation.viewpoints import Viewpoint
from perception.errors import PerceptionError
from perception.inference.meshing import mesh_from_grid
from perception.io.files import write_atomically
from perception.io.images import png_bytes
from perception.rendering.pose import ObjectPose, canonical_from_camera
from perception.rendering.reference import render_reference
from perception.rendering.renderer import RayBundle, Rendering, ShapeGrid, render
from perception.shape.dataset import ShapeDataset, occupancies
from perception.shape.decoder import ShapeDecoder
from perception.shape.evaluation import decode, encode
from perception.shape.network import ShapeVae
from perception.shape.weights import decoder_weights
from perception.types import CATEGORIES, CameraIntrinsics, Category, ObjectEstimate, RgbdFrame

TILE = 112  # [px] side of the image of a shape
SHOWN = 3  # shapes shown of each class
STEPS = 9  # steps of an interpolation
RECONSTRUCTIONS, WALK, PIXEL, CODE = (
    f"shape_{name}.png" for name in ("reconstructions", "walk", "pixel_derivative", "code_derivatives")
)

_SCALE = np.full(3, 0.1 / 1.8)  # an object 0.1 m long
_VIEW = Viewpoint((0.0, 0.0, 0.0), azimuth=np.deg2rad(-50), elevation=np.deg2rad(28), distance=0.5)
_SIDE_VIEW = Viewpoint((0.0, 0.0, 0.0), azimuth=np.deg2rad(180), elevation=np.deg2rad(25), distance=0.5)


def draw_shape_pictures(model: ShapeVae, data: ShapeDataset, folder: Path, device: str = "cpu") -> list[Path]:
    """Write all four figures into the folder and return their paths; ``data`` are held-out shapes."""
    decoder = ShapeDecoder(decoder_weights(model.decoder), device)
    category: Category = CATEGORIES[int(data.categories[0])]
    first = encode(model, occupancies(data.grids[:1]), data.categories[:1], device)[0]
    pictures = {
        RECONSTRUCTIONS: png_bytes(reconstructions(model, data, device)),
        WALK: png_bytes(walk(model, data, device)),
        PIXEL: png_bytes(pixel_derivative(decoder, category, first)),
        CODE: png_bytes(code_derivatives(decoder, category, first)),
    }
    for name, content in pictures.items():
        write_atomically(folder / name, content)
    return [folder / name for name in pictures]


def reconstructions(model: ShapeVae, data: ShapeDataset, device: str) -> UInt8[np.ndarray, "h w 3"]:
    """Return two rows: shapes, and below each its reconstruction by encoder and decoder."""
    chosen = np.concatenate([np.flatnonzero(data.categories == c)[:SHOWN] for c in range(len(CATEGORIES))])
    grids, categories = occupancies(data.grids[chosen]), data.categories[chosen]
    decoded = decode(model, encode(model, grids, categories, device), categories, device)
    rows = [[portrait(g, int(c)) for g, c in zip(shapes, categories)] for shapes in (grids, decoded)]
    return _tiled(rows)


def walk(model: ShapeVae, data: ShapeDataset, device: str) -> UInt8[np.ndarray, "h w 3"]:
    """Return a row for each class: shapes interpolated between the two most different of twenty codes."""
    rows = []
    for c in range(len(CATEGORIES)):
        chosen = np.flatnonzero(data.categories == c)[:20]
        if not len(chosen):
            continue
        codes = encode(model, occupancies(data.grids[chosen]), data.categories[chosen], device)
        distances = np.linalg.norm(codes[:, None] - codes[None], axis=-1)
        a, b = np.unravel_index(int(distances.argmax()), distances.shape)
        line = np.linspace(0, 1, STEPS)[:, None].astype(np.float32)
        path = (1 - line) * codes[a] + line * codes[b]
        grids = decode(model, path, np.full(STEPS, c), device)
        rows.append([portrait(grid, c) for grid in grids])
    return _tiled(rows)


def portrait(grid: Float[np.ndarray, "x y z"], category: int) -> UInt8[np.ndarray, "s s 3"]:
    """Return an image of the shaded surface on white; a white one if the grid has no surface."""
    fine = 3 * TILE
    k = CameraIntrinsics(fine, fine, 3.6 * fine, 3.6 * fine, (fine - 1) / 2, (fine - 1) / 2)
    white, nothing = np.full((fine, fine, 3), 255, np.uint8), np.zeros((fine, fine), np.float32)
    frame = RgbdFrame(0.0, white, nothing, k, _VIEW.camera_pose())
    name = CATEGORIES[category]
    try:
        mesh = mesh_from_grid(grid, _SCALE, name)
    except PerceptionError:
        return np.full((TILE, TILE, 3), 255, np.uint8)
    estimate = ObjectEstimate(category, name, np.zeros(16), np.eye(4), _SCALE, mesh)
    drawn = draw_estimates(frame, [estimate], opacity=1.0, labels=False)
    return np.asarray(cv2.resize(drawn, (TILE, TILE), interpolation=cv2.INTER_AREA), np.uint8)


def pixel_derivative(
    decoder: ShapeDecoder, category: Category, code: Float[np.ndarray, "16"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the depth with one pixel marked, and its derivative with respect to the occupancies."""
    side = 96
    rays, A = _camera(_SIDE_VIEW, side)
    grid, _ = decoder.with_jacobian(category, code)
    image = render(ShapeGrid.upload(grid), rays, A, gradients=False)
    pixel = _wall_pixel(image, side)
    by_occupancy = _by_occupancies(grid, rays, A, pixel)

    figure, (left, right) = _figure(1, 2, (7.2, 3.4))
    left.imshow(_without_background(image, rays, side), cmap="viridis_r")
    left.plot(pixel % side, pixel // side, "o", ms=9, mfc="none", mec="red", mew=1.8)
    left.set_title("rendered depth", fontsize=9)
    # the ray stays near the plane y = 0, so that a slice of the grid shows it
    slice_, derivative = grid[:, 15:17].mean(axis=1), by_occupancy.sum(axis=1)
    box = (-1.0, 1.0, -1.0, 1.0)
    right.imshow(1 - slice_.T, cmap="gray", vmin=0, vmax=1.25, origin="lower", extent=box)
    largest = float(np.abs(derivative).max())
    shown = np.ma.masked_where(np.abs(derivative.T) < 0.01 * largest, 1000 * derivative.T)
    limit = 1000 * largest
    colours = right.imshow(shown, cmap="RdBu", vmin=-limit, vmax=limit, origin="lower", extent=box)
    figure.colorbar(colours, ax=right, fraction=0.046).ax.tick_params(labelsize=7)
    right.set_title("derivative w.r.t. the occupancies [mm]", fontsize=9)
    return _pixels(figure)


def code_derivatives(
    decoder: ShapeDecoder, category: Category, code: Float[np.ndarray, "16"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return depth, its standard deviation, and its derivatives by the ten most effective code entries."""
    side = 96
    rays, A = _camera(_VIEW, side)
    grid, jacobian = decoder.with_jacobian(category, code)
    image = render(ShapeGrid.upload(grid, jacobian), rays, A)
    assert image.d_code is not None
    strongest = np.sort(np.argsort(-np.linalg.norm(image.d_code, axis=0))[:10])
    limit = float(np.quantile(np.abs(image.d_code), 0.999)) + 1e-9
    figure, axes = _figure(2, 6, (10.2, 3.7))
    flat = list(axes.flat)
    flat[0].imshow(_without_background(image, rays, side), cmap="viridis_r")
    flat[0].set_title("depth", fontsize=9)
    flat[1].imshow(np.sqrt(image.variance).reshape(side, side), cmap="magma")
    flat[1].set_title("standard deviation", fontsize=9)
    for axis, entry in zip(flat[2:], strongest):
        axis.imshow(image.d_code[:, entry].reshape(side, side), cmap="RdBu", vmin=-limit, vmax=limit)
        axis.set_title(f"by entry {entry + 1}", fontsize=9)
    return _pixels(figure)


def _camera(view: Viewpoint, side: int) -> tuple[RayBundle, Float[np.ndarray, "1 3 4"]]:
    """Return the rays of a square image from a viewpoint, and the map from camera to canonical cube."""
    line = np.linspace(-0.125, 0.125, side)
    u, v = np.meshgrid(line, line)
    directions = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=-1).astype(np.float32)
    depth_range = np.array([[view.distance - 0.1, view.distance + 0.1]])
    rays = RayBundle(directions, np.zeros(u.size, np.int64), depth_range, samples=160)
    pose = ObjectPose(np.eye(3), np.zeros(3), _SCALE)
    return rays, canonical_from_camera(pose, view.camera_pose()[None])


def _wall_pixel(image: Rendering, side: int) -> int:
    """Return a pixel of the middle column below the rim of a vessel, whose ray crosses several walls."""
    column = np.arange(side) * side + side // 2
    hits = column[image.mask[column] > 0.5]
    return int(hits[int(0.45 * len(hits))]) if len(hits) else int(column[side // 2])


def _by_occupancies(
    grid: Float[np.ndarray, "x y z"], rays: RayBundle, A: Float[np.ndarray, "1 3 4"], pixel: int
) -> Float[np.ndarray, "x y z"]:
    """Return the derivative of one pixel's depth with respect to the occupancies, in metres."""
    leaf = torch.tensor(grid, requires_grad=True)
    image = render_reference(
        leaf,
        torch.from_numpy(rays.directions[pixel : pixel + 1]),
        torch.zeros(1, dtype=torch.int64),
        torch.from_numpy(A).float(),
        torch.from_numpy(rays.depth_range).float(),
        rays.samples,
    )
    return torch.autograd.grad(image.depth.sum(), leaf)[0].numpy()


def _without_background(image: Rendering, rays: RayBundle, side: int) -> np.ma.MaskedArray:
    """Return the depth image with the background masked."""
    return np.ma.masked_where((image.mask < 0.3).reshape(side, side), image.depth.reshape(side, side))


def _tiled(rows: list[list[np.ndarray]]) -> UInt8[np.ndarray, "h w 3"]:
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def _figure(rows: int, columns: int, size: tuple[float, float]):
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    axes = figure.subplots(rows, columns)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    return figure, axes


def _pixels(figure: Figure) -> UInt8[np.ndarray, "h w 3"]:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
