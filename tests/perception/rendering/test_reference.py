"""Hand-computed rays of the reference renderer."""

import pytest
import torch

from perception.rendering.reference import (
    aggregate,
    interpolate,
    render_reference,
    sample_depths,
    termination,
)


def test_samples_follow_the_paper() -> None:
    depths = sample_depths(torch.tensor([[1.0, 2.0]]), 4)
    assert depths.tolist() == [[1.25, 1.5, 1.75, 2.0]]


def test_three_samples_by_hand() -> None:
    # phi = 0.2, 0.8 * 0.5, 0.8 * 0.5 * 0.25; escape 0.8 * 0.5 * 0.75
    occupancy = torch.tensor([[0.2, 0.5, 0.25]])
    phi, escape = termination(occupancy)
    assert phi[0].tolist() == pytest.approx([0.2, 0.4, 0.1])
    assert escape.item() == pytest.approx(0.3)

    # D = 0.2 * 1 + 0.4 * 2 + 0.1 * 3 + 0.3 * 3.3 = 2.29; Var = E[delta^2] - D^2 = 5.967 - 5.2441
    ray = aggregate(occupancy, torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([3.3]))
    assert ray.depth.item() == pytest.approx(2.29)
    assert ray.variance.item() == pytest.approx(0.7229, abs=1e-5)
    assert ray.mask.item() == pytest.approx(0.7)


def test_probabilities_sum_to_one() -> None:
    phi, escape = termination(torch.rand(50, 20, generator=torch.Generator().manual_seed(0)))
    assert torch.allclose(phi.sum(-1) + escape, torch.ones(50))


def test_interpolation_meets_voxel_centres_and_fades_outside() -> None:
    grid = torch.rand(32, 32, 32, generator=torch.Generator().manual_seed(1))
    centre = lambda i: -1 + (2 * i + 1) / 32  # noqa: E731
    points = torch.tensor([[centre(3), centre(8), centre(30)], [centre(3.5), centre(8), centre(30)]])
    values = interpolate(grid, points)
    assert values[0].item() == pytest.approx(grid[3, 8, 30].item(), abs=1e-5)
    assert values[1].item() == pytest.approx((grid[3, 8, 30] + grid[4, 8, 30]).item() / 2, abs=1e-5)
    outside = interpolate(grid, torch.tensor([[1.04, 0.0, 0.0], [0.0, 0.0, -3.0]]))
    assert outside.tolist() == [0.0, 0.0]


def _straight_ray() -> tuple[torch.Tensor, ...]:
    """A camera 3 m below the grid's centre that looks along canonical +z; 1 m per canonical unit."""
    A = torch.tensor([[[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, -3.0]]])
    return torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([0]), A, torch.tensor([[1.5, 4.5]])


def test_empty_grid_escapes() -> None:
    ray = render_reference(torch.zeros(32, 32, 32), *_straight_ray(), samples=96)
    assert ray.depth.item() == pytest.approx(1.1 * 4.5)
    assert ray.variance.item() == pytest.approx(0.0)
    assert ray.mask.item() == 0.0


def test_opaque_slab_stops_the_ray_at_its_face() -> None:
    grid = torch.zeros(32, 32, 32)
    grid[:, :, 8:12] = 1.0  # its first centres at z = -1 + 17/32, so at depth 3 - 15/32
    ray = render_reference(grid, *_straight_ray(), samples=3000)
    assert ray.mask.item() == pytest.approx(1.0)
    assert 3 - 17 / 32 < ray.depth.item() < 3 - 15 / 32
    assert ray.variance.item() < (1 / 32) ** 2
