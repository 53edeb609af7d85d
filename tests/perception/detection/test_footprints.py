"""Grouping of footprints: parts of objects, touching things, in closed form."""

import numpy as np
import pytest

from perception.detection.footprints import Footprint, GroupingConfig, clusters, separate
from perception.types import CATEGORIES, CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

BODY, HANDLE, WHOLE = (0.0, 0.08), (0.09, 0.12), (0.0, 0.12)  # [m] along x
SHOWN = np.ones((4, 4), bool)
UNUSED = RgbdFrame(  # the origin is not in front of it
    0.0,
    np.zeros((4, 4, 3), np.uint8),
    np.ones((4, 4), np.float32),
    CameraIntrinsics(4, 4, 1, 1, 0, 0),
    np.eye(4),
)


def seen(view, x, name="mug", p=0.95):
    """Return the footprint of a strip 8 cm wide, of a class or of 'other'."""
    probabilities = np.full(5, (1 - p) / 4)
    probabilities[(*CATEGORIES, "other").index(name)] = p
    best = int(probabilities[:4].argmax())
    found = ObjectDetection(CATEGORIES[best], float(probabilities[best]), SHOWN, probabilities)
    corners = np.array([(x[0], 0), (x[1], 0), (x[1], 0.08), (x[0], 0.08)], np.float32)
    return Footprint(view, found, np.zeros((1, 3)), corners, UNUSED)


def groups_of(*footprints):
    (cluster,) = clusters(footprints, GroupingConfig())
    return [{f.view for f in group} for group in separate(cluster, GroupingConfig())]


@pytest.mark.parametrize(("name", "p"), [("other", 0.95), ("bottle", 0.6), ("mug", 0.6)])
def test_a_handle_belongs_to_the_mug_that_another_view_shows_whole(name, p):
    assert groups_of(seen(0, BODY), seen(0, HANDLE, name, p), seen(1, WHOLE)) == [{0, 1}]


@pytest.mark.parametrize(
    "other_view",
    [seen(1, WHOLE, "can"), seen(1, WHOLE, p=0.85), seen(1, (0.0, 0.10))],
    ids=["of another class", "uncertain", "without the handle"],
)
def test_a_thing_stays_apart_unless_the_whole_is_certain(other_view):
    groups = groups_of(seen(0, BODY), seen(0, HANDLE, "other"), other_view)
    assert len(groups) == 2


def test_a_thing_stays_apart_if_more_views_separate_it_than_show_a_whole():
    split = [part for view in (0, 1) for part in (seen(view, BODY), seen(view, HANDLE, "other"))]
    assert groups_of(*split, seen(2, WHOLE)) == [{0, 1}, {0, 1}]
    assert groups_of(*split, seen(2, WHOLE), seen(3, WHOLE)) == [{0, 1, 2, 3}]


def test_two_named_objects_stay_two_in_a_tie():
    assert groups_of(seen(0, BODY), seen(0, HANDLE), seen(1, WHOLE)) == [{0}, {0}]


@pytest.mark.parametrize("pieces_in", [0, 1, 2, 3])
def test_what_one_view_shows_in_pieces_is_whole_beside_its_neighbour(pieces_in):
    """Half of the views show two detections, in one of which they are the two pieces of one object."""
    whole, neighbour = (0.03, 0.125), (0.12, 0.145)
    of_view = [[BODY, (0.085, 0.14)], [whole, neighbour], [whole], [whole]]
    of_view = of_view[-pieces_in:] + of_view[:-pieces_in]
    found = [seen(view, strip, "other") for view, strips in enumerate(of_view) for strip in strips]
    assert {0, 1, 2, 3} in groups_of(*found), "of all views"


def test_footprints_far_apart_are_in_different_clusters():
    apart = clusters([seen(0, BODY), seen(1, (0.2, 0.3))], GroupingConfig())
    assert [len(cluster) for cluster in apart] == [1, 1]


def opposite(scenes, *solids):
    """Return what two cameras at opposite sides see of upright cylinders."""
    place = (0.5, 0.0, 0.0)
    views = [scenes.render(list(solids), scenes.orbit(place, 0.6, 25, angle)) for angle in (0, 180)]
    return [
        Footprint.of(k, ObjectDetection("bottle", 0.99, view.instances == i), view.frame, SupportPlane())
        for k, view in enumerate(views)
        for i in range(len(solids))
        if (view.instances == i).sum() > 100
    ]


def test_opposite_sides_of_a_slender_object_are_one(scenes):
    sides = opposite(scenes, scenes.Solid(0.5, 0.0, 0.2, radius=0.025))
    assert [len(cluster) for cluster in clusters(sides, GroupingConfig())] == [2]


def test_objects_behind_each_other_are_two(scenes):
    """Each camera sees the nearer of two cylinders, which hides the other one."""
    near, far = scenes.Solid(0.45, 0.0, 0.2, radius=0.025), scenes.Solid(0.55, 0.0, 0.2, radius=0.025)
    seen_ = [f for f in opposite(scenes, near, far) if f.detection.mask.sum() > 3000]
    assert len({f.view for f in seen_}) == 2
    assert all(len(cluster) == 1 for cluster in clusters(seen_, GroupingConfig()))
