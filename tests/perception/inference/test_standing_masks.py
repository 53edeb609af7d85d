"""Masks around objects whose place is known."""

from dataclasses import replace

import numpy as np
import pytest

from perception.detection.geometry import points_of
from perception.geometry import pose_from_yaw
from perception.inference import standing_masks as module
from perception.inference.standing_masks import standing_masks
from perception.metrics import SurfaceSamples
from perception.types import SupportPlane, TriangleMesh
from tests.perception.inference.test_handle import (
    BODY,
    CAMERA,
    HEIGHT,
    RADIUS,
    REACH,
    at,
    block,
    mug,
    seen_from_above,
)

__all__ = ["mug"]


@pytest.fixture
def masks(mug, monkeypatch):
    """The masks of the mug in images of boxes, beside other objects."""
    monkeypatch.setattr(module, "PIXELS", 100)

    def make(*boxes, others=(), plane=SupportPlane(), margins=module.MARGINS):
        views = [seen_from_above(*boxes)]
        points = [points_of(view, view.depth > 0) for view in views]
        rng = np.random.default_rng(0)
        surfaces = {e.id: SurfaceSamples.of(e.mesh_world, rng, 3000) for e in (mug, *others)}
        return standing_masks(mug, views, points, plane, surfaces, margins)

    return make


def test_a_mask_has_what_is_around_the_axis_and_above_the_support(mug, masks):
    far = (at(0.2, 0.0, 0.0), at(0.25, 0.05, 0.1))
    mask = masks(BODY, far)[0]
    assert mask.sum() == masks(BODY)[0].sum() > 800
    assert masks(BODY, plane=SupportPlane(offset=HEIGHT)) == {}, "nothing is above that"


def test_what_is_nearer_to_another_object_is_not_in_it(mug, masks):
    """Within the reach of the handle, which points elsewhere."""
    beside = block((-0.02, -0.015, 0.0), (0.02, 0.015, 0.06))
    place = at(-RADIUS - 0.028, 0.0, 0.0)
    other = replace(mug, id=2, mesh=TriangleMesh(beside.vertices, beside.faces))
    other = replace(other, T_world_object=pose_from_yaw(0.0, place))
    box = (place + beside.vertices.min(axis=0), place + beside.vertices.max(axis=0))
    alone, without = masks(BODY)[0].sum(), masks(BODY, box, others=[other])[0].sum()
    assert masks(BODY, box)[0].sum() > 1.1 * alone
    assert without == pytest.approx(alone, rel=0.02)


@pytest.mark.parametrize(("margins", "is_whole"), [((0.004, 0.02), False), ((0.02, 0.05), True)])
def test_what_is_larger_than_estimated_is_whole_within_the_margins(mug, masks, margins, is_whole):
    """By 4 cm in height, and by 1.5 cm beyond the handle."""
    taller = (at(-RADIUS, -RADIUS, 0.0), at(RADIUS, RADIUS, HEIGHT + 0.04))
    assert bool(masks(taller, margins=margins)) is is_whole
    wide = (at(-0.085, -0.02, 0.0), at(0.085, 0.02, 0.05))
    _, u = np.nonzero(masks(wide, margins=margins)[0])
    reach = np.abs(u - CAMERA.cx).max() * (0.5 - 0.05) / CAMERA.fx
    assert reach == pytest.approx(0.085 if is_whole else RADIUS + REACH + margins[0], abs=0.003)


def test_views_that_show_little_have_no_mask(mug, masks, monkeypatch):
    count = int(masks(BODY)[0].sum())
    for least, expected in ((count, {0}), (count + 1, set())):
        monkeypatch.setattr(module, "PIXELS", least)
        assert masks(BODY).keys() == expected
