"""Starting poses from clouds."""

from dataclasses import replace

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.geometry import yaw_of
from perception.inference.initialise import (
    CloudMeasures,
    initial_poses,
    measure_clouds,
    plane_basis,
    yaw_hypotheses,
)
from perception.inference.observation import ObjectObservation
from perception.types import SupportPlane

PLANE = SupportPlane()


def _peaked(*yaws: float, bins: int = 36) -> np.ndarray:
    k = np.arange(bins) * 2 * np.pi / bins
    p = sum(np.exp(8 * np.cos(k - yaw)) for yaw in yaws)
    return p / p.sum()


@pytest.mark.parametrize("azimuths", [(0.7,), (0.0, 2.0, 4.0)])
def test_centre_size_and_height_of_a_cylinder(make_table, azimuths) -> None:
    table = make_table("can", (0.0, 0.0), yaw=0.0)
    measures = measure_clouds(table.observations(azimuths), PLANE, plane_basis(PLANE))
    np.testing.assert_allclose(measures.centre, table.pose.translation[:2], atol=0.006)
    assert measures.radius == pytest.approx(0.55 * 0.05, abs=0.004)
    assert measures.height == pytest.approx(1.5 * 0.05, abs=0.005)


def test_pose_stands_on_the_plane(make_table) -> None:
    table = make_table("can", (), yaw=0.0)
    (pose,), measures = initial_poses(table.observations((0.0, 2.0)), "can", PLANE)
    assert pose.translation[2] == pytest.approx(measures.height / 2)
    np.testing.assert_allclose(pose.rotation[:, 2], [0, 0, 1])
    np.testing.assert_allclose(1.8 * pose.scale, 1.5 * 0.05, rtol=0.1)  # its height is its longest side


def test_mug_yaws_are_the_peaks_likeliest_first(make_table) -> None:
    seen = make_table("mug", (), yaw=1.0).observations((0.0,))[0]
    both = _peaked(1.03) ** 8 + 0.5 * _peaked(-2.0) ** 8
    told = ObjectObservation(seen.frame, seen.mask, None, both / both.sum())
    measures = measure_clouds([told], PLANE, plane_basis(PLANE))
    yaws = yaw_hypotheses([told], "mug", measures)
    assert np.cos(np.array(yaws) - [1.03, -2.0]) == pytest.approx([1, 1], abs=0.01)
    blind = yaw_hypotheses([seen], "mug", measures)
    assert len(blind) >= 4


def test_yaws_cover_a_flat_distribution(make_table) -> None:
    seen = make_table("mug", (), yaw=1.0).observations((0.0,))[0]
    flat = _peaked(1.03) ** 0.3
    told = ObjectObservation(seen.frame, seen.mask, None, flat / flat.sum())
    yaws = yaw_hypotheses([told], "mug", measure_clouds([told], PLANE, plane_basis(PLANE)))
    assert np.cos(yaws[0] - 1.03) > 0.99
    assert 3 <= len(yaws) <= 6
    apart = np.abs((np.subtract.outer(yaws, yaws) + np.pi) % (2 * np.pi) - np.pi)
    assert apart[np.triu_indices(len(yaws), 1)].min() > np.deg2rad(20)


def test_unusable_yaw_distributions_are_ignored(make_table) -> None:
    """NaN, zero, another number of bins: the valid one decides, and without any the yaw is unknown."""
    seen = make_table("mug", (), yaw=1.0).observations((0.0,))[0]
    measures = measure_clouds([seen], PLANE, plane_basis(PLANE))
    peaked = _peaked(1.03) ** 4

    def yaws(*distributions: np.ndarray) -> list[float]:
        told = [replace(seen, yaw_probabilities=p) for p in distributions]
        return yaw_hypotheses(told, "mug", measures)

    bad = (np.full(36, np.nan), np.zeros(36))
    assert yaws(*bad) == yaws()
    assert yaws(*bad, peaked / peaked.sum(), np.full(12, 1 / 12)) == yaws(peaked / peaked.sum())


def test_bottles_try_both_ways_of_a_rectangle(make_table) -> None:
    seen = make_table("can", (), yaw=0.0).observations((0.0,))
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 500)) * [[0.03], [0.015]]
    turned = np.stack([np.cos(0.6) * x - np.sin(0.6) * y, np.sin(0.6) * x + np.cos(0.6) * y], axis=-1)
    measures = replace(measure_clouds(seen, PLANE, plane_basis(PLANE)), outline=turned)
    yaws = yaw_hypotheses([], "bottle", measures)
    assert len(yaws) == 2
    assert abs(np.cos(yaws[0] - 0.6)) > 0.97
    assert abs(np.cos(yaws[1] - yaws[0])) < 1e-6


def test_tilted_plane_gives_tilted_objects(make_table) -> None:
    normal = np.array([0.1, 0.0, 1.0]) / np.linalg.norm([0.1, 0.0, 1.0])
    table = make_table("can", (), yaw=0.0)
    plane = SupportPlane(normal, offset=float(normal @ [0.4, -0.1, 0.0]))
    (pose, *_), _ = initial_poses(table.observations((0.0, 2.0)), "can", plane)
    np.testing.assert_allclose(pose.rotation[:, 2], normal, atol=1e-9)
    assert abs(yaw_of(pose.rotation)) < 0.1


def test_a_mask_on_the_table_is_an_error(make_table) -> None:
    seen = make_table("can", (), yaw=0.0).observations((0.0,))[0]
    flat = np.zeros_like(seen.mask)
    flat[-20:, :40] = True
    with pytest.raises(InvalidInputError, match="check the mask, the depth and the plane"):
        initial_poses([ObjectObservation(seen.frame, flat)], "can", PLANE)


def test_bounding_radius_has_a_quarter_of_slack():
    assert CloudMeasures(np.zeros(2), 0.03, 0.08, np.zeros((0, 2))).bounding_radius == pytest.approx(0.0625)
