"""Which evidence makes other poses worth a try, and which of them is kept."""

from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh

from perception.inference.evidence import Evidence
from perception.inference.observation import ObjectObservation
from perception.inference.pose_choice import (
    CLEARLY,
    DOUBTFUL,
    GOOD,
    has_closed_top,
    is_better,
    is_doubtful,
    is_much_closer,
    misfit,
)
from perception.types import CATEGORIES, ObjectEstimate, SupportPlane, TriangleMesh

PLANE = SupportPlane()

PERFECT = replace(Evidence(*[0.0] * len(fields(Evidence))), explained=1.0, converged=1.0)


def with_misfit(value: float, **changes) -> Evidence:
    return replace(PERFECT, explained=1 - value / 2, free_space=value / 2, **changes)


def estimate(tilted: bool = False, **changes) -> ObjectEstimate:
    box = trimesh.creation.box((0.06, 0.06, 0.2))
    vertices = np.asarray(box.vertices)
    if tilted:
        vertices = vertices @ np.array([[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]])
    mesh = TriangleMesh(vertices - (0, 0, vertices[:, 2].min()), np.asarray(box.faces))
    return ObjectEstimate(0, "can", np.zeros(16), np.eye(4), np.ones(3), mesh, **changes)


def test_misfit_adds_unexplained_and_violated_shares() -> None:
    assert misfit(PERFECT) == 0.0
    assert misfit(replace(PERFECT, explained=0.9, free_space=0.2)) == pytest.approx(0.3)


@pytest.mark.parametrize("category", CATEGORIES)
def test_only_a_poor_upright_fit_is_doubtful(category) -> None:
    assert not is_doubtful(with_misfit(0.9 * DOUBTFUL[category]), category)
    assert is_doubtful(with_misfit(1.1 * DOUBTFUL[category]), category)


def test_a_pose_must_be_good_clearly_better_and_at_rest() -> None:
    good, poor = with_misfit(0.5 * GOOD["can"]), with_misfit(0.6)
    assert is_better(good, estimate(), poor, PLANE, False)
    assert is_better(good, estimate(), None, PLANE, False)
    assert not is_better(with_misfit(1.1 * GOOD["can"]), estimate(), None, PLANE, False)
    assert not is_better(good, estimate(), with_misfit(0.4 * GOOD["can"] / CLEARLY), PLANE, False)
    assert not is_better(good, estimate(tilted=True), poor, PLANE, False)
    assert not is_better(good, estimate(status="implausible"), poor, PLANE, False)


def test_a_closed_top_speaks_for_upside_down_alone() -> None:
    upright, other = with_misfit(0.1), with_misfit(0.08)
    assert is_better(other, estimate(resting="upside-down"), upright, PLANE, True)
    assert not is_better(other, estimate(resting="upside-down"), upright, PLANE, False)
    assert not is_better(other, estimate(resting="lying"), upright, PLANE, True)


def test_a_solid_cylinder_has_a_closed_top_and_a_hollow_one_none(make_table) -> None:
    table = make_table("can", (), yaw=0.0)
    seen = table.observations((0.0, 2.0))
    assert has_closed_top(seen, PLANE)
    hollow = []
    for view in seen:  # the middle of the top is seen 2 cm lower
        depth = view.frame.depth.copy()
        points = _points(view)
        middle = view.mask & (np.linalg.norm(points[..., :2] - table.pose.translation[:2], axis=-1) < 0.022)
        depth[middle & (points[..., 2] > 0.06)] += 0.02 / np.sin(0.7)
        hollow.append(ObjectObservation(replace(view.frame, depth=depth), view.mask))
    assert not has_closed_top(hollow, PLANE)


def _points(view: ObjectObservation) -> np.ndarray:
    v, u = np.mgrid[: view.mask.shape[0], : view.mask.shape[1]]
    camera = view.frame.intrinsics
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    points = rays * view.frame.depth[..., None]
    return points @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]


@pytest.mark.parametrize(
    ("other", "systematic", "closer"), [(0.03, 1.3, True), (0.014, 1.3, False), (0.03, 1.2, False)]
)
def test_a_fit_is_much_closer_if_misfit_and_surface_say_so(other, systematic, closer) -> None:
    """0.008 + 0.005 against 0.65 of the other's misfit + 0.005, and 1 against 0.8 of its deviation."""
    one = with_misfit(0.008, systematic=1.0)
    assert is_much_closer(one, with_misfit(other, systematic=systematic)) == closer
    assert not is_much_closer(with_misfit(other, systematic=systematic), one)
