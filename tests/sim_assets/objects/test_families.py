"""The four families: surfaces, inside tests and grids agree; splits are apart; sizes fit a kitchen."""

from functools import cache
from typing import get_args

import numpy as np
import pytest

from perception.types import CATEGORIES
from sim_assets.objects import (
    SPLITS,
    bottle,
    bowl,
    can,
    canonical_scale,
    mug,
    occupancy_grid,
    occupancy_grid_of,
    sample_object,
    sample_parameters,
)
from sim_assets.objects.grids import LONGEST_SIDE, sampled_grid

EVERY = [(category, split) for category in CATEGORIES for split in SPLITS]


@cache
def an_object(category, split):
    return sample_object(category, split, np.random.default_rng(7))


@cache
def many_parameters(category, split):
    rng = np.random.default_rng(11)
    return [sample_parameters(category, split, rng) for _ in range(150)]


@pytest.mark.parametrize(("category", "split"), EVERY)
def test_surface_is_one_closed_body_on_the_table(category, split):
    model = an_object(category, split)
    assert model.mesh.is_watertight and model.mesh.is_winding_consistent and model.mesh.volume > 0
    assert model.mesh.body_count == 1
    assert model.mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(model.mesh.bounds, model.shape.bounds, atol=3e-4)
    assert 0.05 <= model.mass <= 0.6


@pytest.mark.parametrize(("category", "split"), EVERY)
def test_inside_test_agrees_with_the_surface(category, split):
    model = an_object(category, split)
    points, faces = model.mesh.sample(400, return_index=True, seed=1)
    step = 4e-4 * model.mesh.face_normals[faces]
    assert model.inside(points - step).mean() > 0.98
    assert model.inside(points + step).mean() < 0.02


@pytest.mark.parametrize(("category", "split"), EVERY)
def test_grid_holds_the_surface_volume_in_the_agreed_box(category, split):
    model = an_object(category, split)
    grid, (scale, centre) = occupancy_grid(model), canonical_scale(model)
    assert grid.shape == (32, 32, 32) and grid.dtype == np.float32 and grid.min() >= 0 and grid.max() <= 1
    assert grid.sum() * (2 * scale / 32) ** 3 == pytest.approx(model.mesh.volume, rel=0.04)
    canonical = (model.mesh.vertices - centre) / scale
    assert np.ptp(canonical, axis=0).max() == pytest.approx(LONGEST_SIDE, abs=0.01)
    np.testing.assert_allclose(canonical.min(axis=0), -canonical.max(axis=0), atol=0.01)


@pytest.mark.parametrize("category", CATEGORIES)
def test_fast_grid_equals_the_grid_of_the_inside_test(category):
    model = an_object(category, "train")
    slow = sampled_grid(model.inside, model.shape.bounds, resolution=16, supersample=2)
    fast = occupancy_grid(model, resolution=16, supersample=2)
    assert np.abs(slow - fast).max() <= 2 / 8 and np.abs(slow - fast).mean() < 1e-4
    np.testing.assert_array_equal(fast, occupancy_grid_of(model.parameters, resolution=16, supersample=2))


def test_grid_index_order_is_x_y_z_and_handles_point_along_x():
    grid = occupancy_grid(an_object("mug", "test"))
    assert grid[28:].sum() > 0, "the handle reaches the far end of x"
    assert grid[:, :2].sum() == 0 and grid[:, -2:].sum() == 0, "y is the narrow direction"
    np.testing.assert_array_equal(grid, grid[:, ::-1])


@pytest.mark.parametrize(
    ("families", "field", "category"),
    [
        (mug.BODIES, "body", "mug"),
        (bowl.SIDES, "side", "bowl"),
        (bottle.KINDS, "kind", "bottle"),
        (can.KINDS, "kind", "can"),
    ],
)
def test_splits_share_no_family_and_use_all_of_theirs(families, field, category):
    assert not set(families["train"]) & set(families["test"])
    for split in SPLITS:
        assert {getattr(p, field) for p in many_parameters(category, split)} == set(families[split])


KIND_FIELDS = {"mug": "body", "bowl": "side", "bottle": "kind", "can": "kind"}


def coarse_grid(parameters):
    """Occupancy 0..255 on 16³ voxels: an eighth of the cost, the same order of overlaps."""
    return np.round(255 * occupancy_grid_of(parameters, resolution=16)).astype(np.uint8).ravel()


@cache
def training_grids(category):
    rng = np.random.default_rng(101)
    grids = np.array([coarse_grid(sample_parameters(category, "train", rng)) for _ in range(120)])
    return grids, grids.sum(axis=1, dtype=np.int64)


def nearest_iou(category, grid):
    """Soft intersection over union with the nearest of 120 training grids."""
    grids, sums = training_grids(category)
    shared = np.minimum(grids, grid).sum(axis=1, dtype=np.int64)
    return float((shared / (sums + int(grid.sum(dtype=np.int64)) - shared)).max())


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_test_kind_is_farther_from_training_shapes_than_they_are_from_each_other(category):
    rng = np.random.default_rng(102)
    fresh = [coarse_grid(sample_parameters(category, "train", rng)) for _ in range(20)]
    typical = np.median([nearest_iou(category, grid) for grid in fresh])
    kinds: dict[str, list[float]] = {}
    for parameters in many_parameters(category, "test")[:27]:
        overlap = nearest_iou(category, coarse_grid(parameters))
        kinds.setdefault(getattr(parameters, KIND_FIELDS[category]), []).append(overlap)
    for kind, overlaps in kinds.items():
        assert np.median(overlaps) < typical - 0.01, kind
        assert max(overlaps) < 0.98, f"a {kind} {category} equals a training shape"


def test_handle_styles_are_the_same_but_their_curves_are_not():
    curves = {}
    for split in SPLITS:
        handles = [p.handle for p in many_parameters("mug", split)]
        assert {handle.style for handle in handles} == {"c", "d", "ear", "square"}
        curves[split] = {handle.curve for handle in handles}
    assert not curves["train"] & curves["test"]


@pytest.mark.parametrize("split", SPLITS)
def test_sizes_suit_kitchen_and_gripper(split):
    for p in many_parameters("mug", split):
        assert 0.032 <= p.radius <= 0.050 and 0.055 <= p.height <= 0.120
        assert (0.0014 if split == "train" else 0.0022) <= p.wall.rim <= 0.006
        assert 0 < p.handle.bottom < p.handle.top < p.height
    for p in many_parameters("bowl", split):
        assert 0.045 <= p.radius <= 0.090 and 0.035 <= p.height <= 0.090 and p.wall.rim <= 0.008
    for p in many_parameters("bottle", split):
        assert 0.120 <= p.height <= 0.260 and 2 * p.cap_radius <= bottle.WIDEST_GRIP
    for p in many_parameters("can", split):
        assert 0.024 <= p.radius <= can.WIDEST and 0.060 <= p.height <= 0.170


@pytest.mark.parametrize("category", CATEGORIES)
def test_model_has_the_height_and_radius_of_its_parameters(category):
    model = an_object(category, "test")
    assert model.height == pytest.approx(model.parameters.height, abs=1e-3)
    section = getattr(model.parameters, "aspect", 1.0)
    assert model.radius == pytest.approx(model.parameters.radius * section, rel=0.06)


def test_handle_points_are_those_beyond_the_body():
    model = an_object("mug", "test")
    points = model.mesh.sample(3000, seed=2)
    handle = points[model.is_handle(points)]
    assert 0.02 < len(handle) / len(points) < 0.3
    assert (np.hypot(handle[:, 0], handle[:, 1]) > 0.8 * model.radius).all() and (handle[:, 0] > 0).all()
    beyond = points[points[:, 0] > model.radius + 3e-3]
    assert model.is_handle(beyond).all()
    assert not an_object("can", "test").is_handle(points).any()


def test_handle_curves_of_the_table_exist():
    from sim_assets.objects.handles import HandleCurve

    used = {curve for split in SPLITS for curve in mug.CURVES[split].values()}
    assert used == set(get_args(HandleCurve))
