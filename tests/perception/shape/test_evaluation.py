"""Scores of known pairs of shapes, and reconstructions of analytic shapes by the shipped prior."""

import numpy as np
import pytest

from perception.shape.dataset import ShapeDataset
from perception.shape.evaluation import (
    decode,
    encode,
    evaluate,
    handle_recall,
    iou,
    surface_error,
    surface_points,
)
from perception.shape.weights import load_weights
from perception.types import CATEGORIES

# 4^3 samples in a voxel, so that surfaces lie between voxels
FINE = (2.0 * np.arange(128) + 1) / 128 - 1
X, Y, Z = np.meshgrid(FINE, FINE, FINE, indexing="ij", sparse=True)


def voxels(inside: np.ndarray) -> np.ndarray:
    """Share of the samples inside, (32, 32, 32) float32."""
    return inside.reshape(32, 4, 32, 4, 32, 4).mean((1, 3, 5)).astype(np.float32)


def can(radius: float, height: float) -> np.ndarray:
    return voxels((np.hypot(X, Y) < radius) & (abs(Z) < height))


def bowl(rim: float, height: float, wall: float) -> np.ndarray:
    """A cone frustum with a flat base."""
    outer = rim * (0.7 + 0.3 * Z / height)
    cavity = (np.hypot(X, Y) < outer - wall) & (wall - height < Z)
    return voxels((np.hypot(X, Y) < outer) & (abs(Z) < height) & ~cavity)


def bottle(radius: float, neck: float) -> np.ndarray:
    profile = np.where(Z < 0.3, radius, np.where(Z < 0.5, radius + (neck - radius) * (Z - 0.3) / 0.2, neck))
    return voxels((np.hypot(X, Y) < profile) & (abs(Z) < 0.9))


def mug(radius: float, height: float, wall: float, handle: bool = True) -> np.ndarray:
    """A cylinder with a C handle: half a ring of round section."""
    x = X + (0.9 - radius)  # the body at -x, so that the handle ends at +0.9
    body = (np.hypot(x, Y) < radius) & (abs(Z) < height)
    body = body & ~((np.hypot(x, Y) < radius - wall) & (wall - height < Z))
    ring = 0.65 * height
    reach = 1.8 - 2 * radius - 0.07  # how far the ring's centre line sticks out
    around = np.hypot((x - radius) / reach, Z / ring) - 1
    torus = (np.hypot(around * min(reach, ring), Y) < 0.07) & (x > radius - 0.5 * wall)
    return voxels(body | torus if handle else body)


def test_iou_of_known_boxes():
    a, b = np.zeros((2, 4, 4, 4), np.float32)
    a[:2], b[1:3] = 1, 1
    assert iou(a, a) == 1.0
    assert iou(a, b) == pytest.approx(1 / 3)
    assert iou(a * 0, b * 0) == 1.0


def test_surface_error_of_nested_spheres_is_the_gap():
    distance = np.sqrt(X**2 + Y**2 + Z**2)
    small, large = voxels(distance < 0.5), voxels(distance < 0.625)
    assert surface_error(small, large) == pytest.approx(2.0, abs=0.1)  # 0.125 is two voxels of 1/16
    assert surface_error(small, small) == 0.0
    assert surface_error(small, small * 0) == float("inf")


def test_surface_points_cover_the_surface():
    points = surface_points(can(0.5, 0.5))
    from_axis = np.hypot(points[:, 0] - 15.5, points[:, 1] - 15.5)
    side = abs(points[:, 2] - 15.5) < 6
    assert from_axis[side] == pytest.approx(8.0, abs=0.35)
    assert len(surface_points(np.zeros((32, 32, 32), np.float32))) == 0


def test_handle_recall_counts_the_handle_alone():
    whole, without = mug(0.6, 0.6, 0.1), mug(0.6, 0.6, 0.1, handle=False)
    region = np.zeros((32, 32, 32), bool)
    region[23:] = True
    assert handle_recall(whole, whole, region) == 1.0
    assert handle_recall(without, whole, region) < 0.2
    assert handle_recall(whole * 0, whole, region) == 0.0
    assert np.isnan(handle_recall(whole, without, region))


ANALYTIC = {
    "mug": [mug(0.62, 0.65, 0.11), mug(0.66, 0.55, 0.13), mug(0.58, 0.75, 0.10)],
    "bowl": [bowl(0.9, 0.4, 0.12), bowl(0.9, 0.3, 0.10)],
    "bottle": [bottle(0.3, 0.12), bottle(0.25, 0.1)],
    "can": [can(0.55, 0.9), can(0.3, 0.9), can(0.9, 0.8)],
}


@pytest.fixture(scope="module")
def shipped():
    return load_weights()


@pytest.mark.parametrize(
    ("category", "least_iou"), [("mug", 0.7), ("bowl", 0.65), ("bottle", 0.85), ("can", 0.93)]
)
def test_shipped_weights_reproduce_analytic_shapes(shipped, category, least_iou):
    truth = np.array(ANALYTIC[category])
    categories = np.full(len(truth), CATEGORIES.index(category))
    decoded = decode(shipped, encode(shipped, truth, categories), categories)
    assert min(iou(a, b) for a, b in zip(decoded, truth)) > least_iou
    assert max(surface_error(a, b) for a, b in zip(decoded, truth)) < 0.6


def test_shipped_weights_keep_handles_at_the_iso_level(shipped):
    data = ShapeDataset.from_grids({"mug": np.array(ANALYTIC["mug"])})
    scores = evaluate(shipped, data)
    assert set(scores) == {"mug"}
    assert scores["mug"].handle_recall > 0.85
    assert 0.3 < scores["mug"].code_spread < 2


def test_the_mean_code_is_an_object_of_the_right_size(shipped):
    for category, grid in zip(CATEGORIES, decode(shipped, np.zeros((4, 16), np.float32), np.arange(4))):
        occupied = np.argwhere(grid > 0.25)  # thin walls of the mean shape are blurred to below 0.5
        # The longest side is 0.9 of the grid: of flat tins the width, of tubes the height.
        least = 22 if category == "can" else 25
        assert least <= np.ptp(occupied, axis=0).max() + 1 <= 31
        assert abs(occupied.min(0) + occupied.max(0) - 31).max() <= 5  # centred
