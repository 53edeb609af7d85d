"""Grouping of footprints: parts of objects, touching things, in closed form."""

import numpy as np
import pytest

from perception.detection.footprints import Footprint, GroupingConfig, clusters, separate
from perception.types import CATEGORIES, ObjectDetection

BODY, HANDLE, WHOLE = (0.0, 0.08), (0.09, 0.12), (0.0, 0.12)  # [m] along x
SHOWN = np.ones((4, 4), bool)


def seen(view, x, name="mug", p=0.95):
    """Return the footprint of a strip 8 cm wide, of a class or of 'other'."""
    probabilities = np.full(5, (1 - p) / 4)
    probabilities[(*CATEGORIES, "other").index(name)] = p
    best = int(probabilities[:4].argmax())
    found = ObjectDetection(CATEGORIES[best], float(probabilities[best]), SHOWN, probabilities)
    corners = np.array([(x[0], 0), (x[1], 0), (x[1], 0.08), (x[0], 0.08)], np.float32)
    return Footprint(view, found, np.zeros((1, 3)), corners)


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


def test_footprints_far_apart_are_in_different_clusters():
    apart = clusters([seen(0, BODY), seen(1, (0.2, 0.3))], GroupingConfig())
    assert [len(cluster) for cluster in apart] == [1, 1]
