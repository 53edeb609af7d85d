"""Sizes of objects from further images: fitted anew, and kept where they agree with what is measured."""

from dataclasses import replace

import pytest

from perception.geometry import pose_from_yaw
from perception.inference import remeasuring, standing_masks
from perception.inference.remeasuring import NEAR, remeasured
from perception.types import SupportPlane
from tests.perception.inference.test_handle import BODY, HEIGHT, RADIUS, at, block, mug, seen_from_above

__all__ = ["mug"]
PLANE = SupportPlane()


class Network:
    """Keeps the detections of each image."""

    def __init__(self):
        self.rows = []

    def complete(self, frame, plane, detections):
        assert plane is PLANE
        self.rows.append(list(detections))
        return list(detections)


@pytest.fixture
def box(mug):
    """What stands there: a box of the size of the mug's body."""
    T = pose_from_yaw(0.0, at(0.0, 0.0, 0.0))
    body = block((-RADIUS, -RADIUS, 0.0), (RADIUS, RADIUS, HEIGHT))
    return replace(mug, id=1, category="can", mesh=body, T_world_object=T)


@pytest.fixture
def measure(box, decoder, monkeypatch):
    """What is made of a fit of the box in two images, and the network that was asked."""
    monkeypatch.setattr(standing_masks, "PIXELS", 100)

    def run(fit, estimates=None, frames=(seen_from_above(BODY),) * 2, ids=None):
        network = Network()
        monkeypatch.setattr(remeasuring, "reconstruct", lambda frames, rows, decoder, plane: [fit])
        return remeasured(estimates or {1: box}, frames, PLANE, network, decoder, ids), network

    return run


def test_a_fit_that_explains_what_is_measured_replaces_the_estimate(box, measure):
    fit = replace(box, score=1.0)
    found, network = measure(fit)
    assert found.keys() == {1} and found[1].mesh is fit.mesh
    assert found[1].score == box.score, "that of the evidence which it had"
    assert [[(d.category, d.instance_id) for d in row] for row in network.rows] == [[("can", 1)]] * 2


@pytest.mark.parametrize(
    ("x", "height", "status"),
    [(1.1 * NEAR, HEIGHT, "converged"), (0.0, 0.7 * HEIGHT, "converged"), (0.0, HEIGHT, "implausible")],
)
def test_a_fit_that_is_elsewhere_or_explains_less_is_not_kept(box, measure, x, height, status):
    T = box.T_world_object.copy()
    T[0, 3] += x
    mesh = block((-RADIUS - x, -RADIUS, 0.0), (RADIUS - x, RADIUS, height))
    assert measure(replace(box, T_world_object=T, mesh=mesh, status=status))[0] == {}


def test_what_stands_beside_it_is_not_in_its_masks(box, measure):
    half = block((-RADIUS, -RADIUS, 0.0), (0.0, RADIUS, HEIGHT))
    own = replace(box, mesh=block((0.0, -RADIUS, 0.0), (RADIUS, RADIUS, HEIGHT)))
    _, together = measure(box)
    _, network = measure(own, {1: own, 2: replace(box, id=2, mesh=half)})
    (first, second), _ = network.rows
    assert (first.instance_id, second.instance_id) == (1, 2)
    assert first.mask.sum() == pytest.approx(together.rows[0][0].mask.sum() / 2, rel=0.1)
    _, alone = measure(own, {1: own, 2: replace(box, id=2, mesh=half)}, ids=[1])
    assert [[d.instance_id for d in row] for row in alone.rows] == [[1]] * 2
    assert (alone.rows[0][0].mask == first.mask).all(), "what is not measured hides it all the same"


def test_images_that_cut_it_are_not_used(box, measure):
    """It may be much higher than what they show."""
    whole = seen_from_above(BODY)
    beside = whole.T_world_camera.copy()
    beside[0, 3] += 0.33
    cut = replace(seen_from_above(), T_world_camera=beside)
    depth = cut.depth.copy()
    depth[40:80, :30] = 0.5 - HEIGHT  # the half of it that is in view
    _, network = measure(box, frames=(whole, replace(cut, depth=depth)))
    assert [len(row) for row in network.rows] == [1, 0]
