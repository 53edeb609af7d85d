"""Grids in eight bits: conversion, mirroring, batches and files."""

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.shape.dataset import ShapeDataset, mirrored, occupancies
from perception.types import CATEGORIES

AXIS = np.arange(32) - 15.5
X, Y, Z = np.meshgrid(AXIS, AXIS, AXIS, indexing="ij")
MUG, CAN = CATEGORIES.index("mug"), CATEGORIES.index("can")


def cylinder(radius: float, x: float = 0.0) -> np.ndarray:
    return (np.hypot(X - x, Y) < radius) & (abs(Z) < 13)


def mug(radius: float) -> np.ndarray:
    """A body standing left of the middle with a bar, three voxels thick, as its handle."""
    body = cylinder(radius, x=-4) & ~(cylinder(radius - 2, x=-4) & (Z > -11))
    return body | ((-4 + radius < X) & (X < 13) & (abs(Y) < 2) & (abs(Z) < 2))


@pytest.fixture(scope="module")
def shapes() -> ShapeDataset:
    radii = np.linspace(6, 10, 16)  # [voxel]
    grids = {"mug": [mug(radius) for radius in radii], "can": [cylinder(radius) for radius in radii]}
    return ShapeDataset.from_grids({name: np.array(value, np.float32) for name, value in grids.items()})


def test_mirroring_keeps_handles_in_front():
    grids = np.repeat((mug(8)[None] * 255).astype(np.uint8), 16, 0)
    grids[:, :, :10] = 0  # something to tell left from right by
    mugs = mirrored(grids, np.full(16, MUG), np.random.default_rng(0))
    cans = mirrored(grids, np.full(16, CAN), np.random.default_rng(0))
    assert {bool((grid == grids[0]).all()) for grid in mugs} == {True, False}
    assert (mugs.any((2, 3)) == grids.any((2, 3))).all()
    assert not (cans.any((2, 3)) == grids.any((2, 3))).all()


def test_data_survive_the_file(shapes, tmp_path):
    path = tmp_path / "shapes.npz"
    shapes.save(path)
    loaded = ShapeDataset.load(path)
    assert np.array_equal(loaded.grids, shapes.grids)
    assert np.array_equal(loaded.of("can").categories, np.full(16, CAN))
    assert occupancies(loaded.grids).max() == 1.0
    for content in (path.read_bytes()[:1000], b""):
        path.write_bytes(content)
        with pytest.raises(InvalidInputError, match="delete it"):
            ShapeDataset.load(path)


def test_wrong_grids_are_refused():
    with pytest.raises(InvalidInputError, match="expected uint8"):
        ShapeDataset(np.zeros((2, 16, 16, 16), np.uint8), np.zeros(2, int))
    with pytest.raises(InvalidInputError, match=r"in 0\.\.3"):
        ShapeDataset(np.zeros((1, 32, 32, 32), np.uint8), np.array([4]))
    with pytest.raises(InvalidInputError, match=r"\[0, 1\]"):
        ShapeDataset.from_grids({"mug": np.full((1, 32, 32, 32), np.nan, np.float32)})


def test_occupancies_are_rounded_to_eight_bits():
    grid = np.full((1, 32, 32, 32), 0.5, np.float32)
    data = ShapeDataset.from_grids({"bowl": grid, "can": np.full((2, 32, 32, 32), 7, np.uint8)})
    assert data.grids[0, 0, 0, 0] == 128 and data.grids[1, 0, 0, 0] == 7
    assert data.categories.tolist() == [CATEGORIES.index("bowl"), *[CATEGORIES.index("can")] * 2]
    np.testing.assert_allclose(occupancies(np.array([0, 51, 255], np.uint8)), [0, 0.2, 1])


def test_an_epoch_has_every_shape_once_in_random_order():
    grids = np.broadcast_to(np.arange(10, dtype=np.uint8)[:, None, None, None], (10, 32, 32, 32))
    data = ShapeDataset(grids, np.arange(10) % 4)
    batches = list(data.batches(4, np.random.default_rng(0)))
    assert [len(grids) for grids, _ in batches] == [4, 4, 2]
    values = np.concatenate([grids[:, 0, 0, 0] for grids, _ in batches])
    assert sorted(values) == list(range(10)) and values.tolist() != list(range(10))
    assert all((grids[:, 0, 0, 0] % 4 == categories).all() for grids, categories in batches)


def test_half_of_the_shapes_are_mirrored():
    marked = np.zeros((400, 32, 32, 32), np.uint8)
    marked[:, 0, 0] = 1
    flipped = mirrored(marked, np.full(400, CAN), np.random.default_rng(0))
    for axis in (1, 2):
        share = np.take(flipped.any(axis=(3, 3 - axis)), 31, axis=1).mean()
        assert share == pytest.approx(0.5, abs=0.08)
