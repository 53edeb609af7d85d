"""Evidence of fits of known quality: right, displaced, too large, and of other cross-sections."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.geometry import rigid
from perception.inference.evidence import (
    _block_means,
    measure_evidence,
    noise_sigma,
    section_shapes,
    tolerance,
)
from perception.inference.fit import fit_with_grid
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectObservation, ObjectViews
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

PLANE, STEP = SupportPlane(), FitConfig().step["can"]


@pytest.fixture(scope="module")
def fitted(can, decoder):
    observations = can.observations((0.0, 2.0))
    views = ObjectViews(0, "can", 1.0, tuple(observations))
    return *fit_with_grid(views, decoder, PLANE), observations


def evidence_of(fitted, move=(0.0, 0.0, 0.0), scale=1.0):
    """The evidence of the fit after a displacement and a change of size."""
    estimate, grid, observations = fitted
    T = np.array(estimate.T_world_object)
    T[:3, 3] += move
    mesh = TriangleMesh(scale * estimate.mesh.vertices, estimate.mesh.faces)
    changed = replace(estimate, T_world_object=T, scale=scale * estimate.scale, mesh=mesh)
    return measure_evidence(changed, grid, observations, PLANE, STEP)


def test_a_good_fit_explains_its_mask_and_no_free_space(fitted) -> None:
    seen = evidence_of(fitted)
    assert seen.explained > 0.97 and seen.free_space < 0.01
    assert max(seen.uncovered, seen.in_front, seen.behind) < 0.02
    assert seen.residual < 1.5 and seen.systematic < 1.5
    assert abs(seen.base) < 0.15 and seen.missing == 0.0 and seen.truncated == 0.0
    assert seen.height == pytest.approx(2 * 0.67 * 0.05, abs=0.003)
    assert seen.converged == 1.0


def test_a_displaced_shape_leaves_pixels_uncovered_and_fills_free_space(fitted) -> None:
    seen = evidence_of(fitted, (0.0, 0.04, 0.0))
    assert seen.uncovered > 0.2 and seen.free_space > 0.2 and seen.explained < 0.5


def test_a_shape_that_is_too_large_fills_free_space_and_covers_the_mask(fitted) -> None:
    seen = evidence_of(fitted, scale=1.4)
    assert seen.free_space > 0.2 and seen.uncovered < 0.02 and seen.behind > 0.1


def test_a_shape_behind_the_surface_is_in_front_of_nothing(fitted) -> None:
    (estimate, grid, observations) = fitted
    T = observations[0].T_world_camera
    one_view = (estimate, grid, observations[:1])
    seen = evidence_of(one_view, 0.04 * T[:3, 2])  # away from the camera
    assert seen.in_front > 0.5 and seen.behind < 0.05


def test_ignored_pixels_do_not_count(fitted) -> None:
    estimate, grid, observations = fitted
    hidden = [replace(seen, ignore=~seen.mask) for seen in observations]
    moved = evidence_of((estimate, grid, hidden), (0.0, 0.04, 0.0))
    assert moved.free_space == 0.0 and moved.uncovered > 0.2


def test_base_and_missing_depth(fitted) -> None:
    """Without the lower half of its depth an object seems to float."""
    estimate, grid, observations = fitted
    seen = observations[0]
    rows = np.flatnonzero(seen.mask.any(axis=1))
    depth = seen.frame.depth.copy()
    depth[rows[len(rows) // 2] :] = 0.0
    cut = ObjectObservation(replace(seen.frame, depth=depth), seen.mask)
    half = measure_evidence(estimate, grid, [cut], PLANE, STEP)
    assert 0.3 < half.missing < 0.7 and half.base > 0.3
    low = measure_evidence(estimate, grid, [cut], SupportPlane(offset=0.1), STEP)
    assert low.base < -0.3


def test_sections() -> None:
    def shapes(mesh: trimesh.Trimesh) -> tuple[float, float]:
        dense = mesh.subdivide_to_size(0.006)
        return section_shapes(
            ObjectEstimate(0, "bottle", np.zeros(16), rigid(np.eye(3), np.zeros(3)), np.full(3, 0.1),
                           TriangleMesh(dense.vertices, dense.faces))
        )  # fmt: skip

    neck, box = shapes(trimesh.creation.cylinder(0.03, 0.2, sections=64))
    assert neck == pytest.approx(1.0, abs=0.02) and box == pytest.approx(np.pi / 4, abs=0.02)
    neck, box = shapes(trimesh.creation.box((0.05, 0.08, 0.2)))
    assert neck == pytest.approx(1.0, abs=0.01) and box == pytest.approx(1.0, abs=0.01)
    neck, _ = shapes(trimesh.creation.cone(0.05, 0.2, sections=64))
    assert neck < 0.15  # the slab from 88 % of the height on


def test_noise_averages_out_of_block_means() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1, (40, 40))
    assert np.sqrt((_block_means(noise) ** 2).mean()) < 0.3
    assert np.sqrt((_block_means(noise + 2) ** 2).mean()) == pytest.approx(2, abs=0.1)
    assert not len(_block_means(np.full((40, 40), np.nan)))


def test_tolerance_grows_with_the_distance() -> None:
    depth = np.array([0.3, 0.6, 1.2])
    assert (np.diff(noise_sigma(depth)) > 0).all() and (np.diff(tolerance(depth)) > 0).all()
