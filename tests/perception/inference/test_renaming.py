"""What the network is asked about objects that stand alone, and what follows from its answers."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference import renaming, standing_masks
from perception.inference.renaming import bowl_probability, mistaken_bowls
from perception.types import SupportPlane, is_unclassified
from tests.perception.inference.test_handle import AT, BODY, CAMERA, RADIUS, at, mug, seen_from_above

PLANE = SupportPlane()
__all__ = ["mug"]


class Network:
    """Gives all masks the same class probabilities, and keeps the masks."""

    def __init__(self, mug=0.0, bowl=0.0, other=0.0):
        self.p, self.masks = np.array([mug, bowl, 0.0, 0.0, other]), []

    def complete(self, frame, plane, detections):
        (detection,) = detections
        assert is_unclassified(detection) and plane is PLANE
        self.masks.append(detection.mask)
        return [replace(detection, class_probabilities=self.p)]


@pytest.fixture
def fitted(monkeypatch):
    """The rows that are reconstructed."""
    rows = []
    monkeypatch.setattr(standing_masks, "PIXELS", 100)
    monkeypatch.setattr(
        renaming, "reconstruct", lambda frames, given, decoder, plane, options: rows.extend(given) or []
    )
    return rows


def test_what_the_network_takes_for_a_bowl_is_reconstructed_as_one(mug, decoder, fitted):
    far = (at(0.2, 0.0, 0.0), at(0.25, 0.05, 0.1))
    frames = [seen_from_above(BODY, far)] * 2
    network = Network(mug=0.02, bowl=0.7, other=0.28)
    mistaken_bowls({1: mug}, frames, PLANE, network, decoder)
    assert [(d.category, d.instance_id, d.class_probabilities.size) for row in fitted for d in row] == [
        ("bowl", 1, 0)
    ] * 2
    _, u = np.nonzero(network.masks[0])
    z = 0.5 - BODY[1][2]
    x = AT[0] + (u - CAMERA.cx) * z / CAMERA.fx
    assert np.abs(x - AT[0]).max() < RADIUS + 0.01, "neither the table nor what stands beside it"
    assert network.masks[0].sum() == pytest.approx((2 * RADIUS / z * CAMERA.fx) ** 2, rel=0.1)


@pytest.mark.parametrize(
    ("network", "n_views"),
    [(Network(mug=0.3, bowl=0.7), 2), (Network(bowl=0.15, other=0.85), 2), (Network(bowl=1.0), 1)],
)
def test_what_may_be_something_else_or_is_hardly_seen_keeps_its_class(mug, decoder, fitted, network, n_views):
    mistaken_bowls({1: mug}, [seen_from_above(BODY)] * n_views, PLANE, network, decoder)
    assert fitted == []


def test_bowls_are_not_looked_at(mug, decoder, fitted):
    network = Network(bowl=1.0)
    frames = [seen_from_above(BODY)] * 2
    assert mistaken_bowls({1: replace(mug, category="bowl")}, frames, PLANE, network, decoder) == {}
    assert network.masks == [] and fitted == []


def test_larger_masks_count_more():
    class Sizes(Network):
        def complete(self, frame, plane, detections):
            self.p = np.eye(5)[1 if detections[0].mask.sum() > 150 else 0]
            return super().complete(frame, plane, detections)

    frame = seen_from_above(BODY)
    masks = {k: np.zeros(frame.depth.shape, bool) for k in range(2)}
    masks[0][:10, :10], masks[1][:10, :90] = True, True
    assert bowl_probability(masks, [frame, frame], PLANE, Sizes()) == pytest.approx(0.9)
