"""The next image is taken from where it shows what is uncertain."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.grasps import grasp_candidates
from manipulation.next_view import next_viewpoint, risk_of, shown_share
from manipulation.robot import GripperGeometry
from manipulation.standing import to_standing
from manipulation.types import GraspSet
from manipulation.viewpoints import Viewpoint

TARGET = (0.45, -0.3, 0.05)
VIEWS = {name: Viewpoint(TARGET, azimuth, 0.7, 0.5) for name, azimuth in
         (("+x", 0.0), ("+y", np.pi / 2), ("-x", np.pi), ("-y", -np.pi / 2))}  # fmt: skip


def can(shapes, number=1, x=0.45, hidden=None, radius=0.03, height=0.1):
    """A can whose surface on one side is uncertain to a centimetre."""
    found = shapes.estimate(number, "can", shapes.can(radius, height), x=x)
    side = np.zeros(len(found.mesh.vertices), bool) if hidden is None else found.mesh.vertices @ hidden > 0.01
    return replace(found, surface_sigma=np.where(side, 0.01, 0.0005))


@pytest.mark.parametrize("name, side", [("+x", (1.0, 0, 0)), ("-y", (0, -1.0, 0))])
def test_the_viewpoint_on_the_hidden_side_is_chosen(shapes, name, side):
    seen = can(shapes, hidden=np.array(side))
    assert next_viewpoint([seen], {1: 0.5}, list(VIEWS.values())) is VIEWS[name]
    shares = {key: shown_share(seen, view, [seen]) for key, view in VIEWS.items()}
    opposite = {"+x": "-x", "-y": "+y"}[name]
    assert shares[opposite] < 0.1 * shares[name] < 0.1


def test_what_hides_the_object_makes_another_viewpoint_better(shapes):
    seen = can(shapes, hidden=np.array([1.0, 0, 0]))
    tower = can(shapes, 2, x=0.55, radius=0.05, height=0.5)
    assert shown_share(seen, VIEWS["+x"], [seen, tower]) == 0.0
    assert next_viewpoint([seen, tower], {1: 0.5}, list(VIEWS.values())) is not VIEWS["+x"]


def test_no_image_is_taken_for_objects_without_risk_or_deviations(shapes):
    seen = can(shapes, hidden=np.array([1.0, 0, 0]))
    views = list(VIEWS.values())
    assert next_viewpoint([seen], {1: 0.2}, views) is None and next_viewpoint([seen], {}, views) is None
    assert next_viewpoint([replace(seen, surface_sigma=None)], {1: 0.9}, views) is None
    assert next_viewpoint([seen], {1: 0.9}, []) is None


def test_the_risk_is_that_of_the_class_and_of_the_best_grasp(shapes):
    hand = GripperGeometry()
    sure = can(shapes)
    grasps = grasp_candidates(to_standing(sure))
    assert risk_of(replace(sure, score=0.7), to_standing(sure), grasps, hand) == pytest.approx(0.3)
    vague = replace(sure, surface_sigma=np.full(len(sure.mesh.vertices), 0.05), score=1.0)
    assert 0.5 < risk_of(vague, to_standing(vague), grasps, hand) < 1.0
    none = GraspSet((), grasps.rejected)
    assert risk_of(replace(vague, score=0.9), to_standing(vague), none, hand) == pytest.approx(0.1)
