"""Landmarks from fits: plausible ones, failures and refits."""

from dataclasses import replace

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.inference.fit_config import FitConfig, FitStage
from perception.slam import initialise
from perception.slam.initialise import LandmarkViews, initialise_landmark, refitted
from perception.slam.keyframes import Keyframe
from perception.slam.landmarks import log_probabilities

FAST_FIT = FitConfig(stages=(FitStage(32, 1, 5), FitStage(40, 0, 6)))


@pytest.fixture(scope="module")
def views(observe, T_view):
    view = observe(T_view)
    label, id = next(iter(view.landmark_of.items()))
    observation = Keyframe.of(view, np.eye(6)).observation(id)
    return LandmarkViews(5, [observation], view.detections[label - 1], 12)


@pytest.fixture(scope="module")
def landmark(views, cylinders):
    return initialise_landmark(views, cylinders.decoder, cylinders.plane, FAST_FIT)


def test_a_landmark_is_fitted_to_its_view(landmark, views, cylinders):
    x, y, radius = cylinders.places[0]
    assert np.hypot(*(landmark.state.pose.translation[:2] - (x, y))) < 0.004
    assert landmark.bounding_radius > radius
    assert (landmark.id, landmark.category, landmark.first_frame) == (5, "can", 12)
    assert landmark.sample_step == FAST_FIT.step["can"] and landmark.score == 0.9
    assert (landmark.n_hits, landmark.n_updates, landmark.truncated) == (1, 1, False)
    assert 0 < landmark.residual < 0.01
    np.testing.assert_array_equal(landmark.log_votes, log_probabilities(views.detection))
    np.testing.assert_array_equal(landmark.shape.code, landmark.state.code)


def test_a_mask_at_the_image_border_makes_a_truncated_landmark(views, cylinders):
    mask = np.array(views.detection.mask)
    mask[0, :5] = True
    truncated = replace(views, detection=replace(views.detection, mask=mask))
    landmark = initialise_landmark(truncated, cylinders.decoder, cylinders.plane, FAST_FIT)
    assert landmark is not None and landmark.truncated


def test_an_implausible_fit_makes_no_landmark(views, cylinders, monkeypatch):
    fit = initialise.fit_object

    def implausible(*args):
        return replace(fit(*args), status="implausible")

    monkeypatch.setattr(initialise, "fit_object", implausible)
    assert initialise_landmark(views, cylinders.decoder, cylinders.plane, FAST_FIT) is None


def test_a_failed_fit_makes_no_landmark(views, cylinders, monkeypatch):
    def failing(*args):
        raise InvalidInputError("nothing above the plane")

    monkeypatch.setattr(initialise, "fit_object", failing)
    assert initialise_landmark(views, cylinders.decoder, cylinders.plane, FAST_FIT) is None


def test_a_refit_keeps_identity_votes_and_counts(landmark, cylinders):
    votes = np.array([1.0, 2.0, 3.0, 4.0])
    old = replace(cylinders.landmark(2), log_votes=votes, n_hits=9, n_updates=3, n_outlier_frames=4)
    new = refitted(old, landmark)
    assert (new.id, new.n_hits, new.n_updates, new.n_outlier_frames) == (2, 9, 4, 0)
    assert new.state is landmark.state and new.category == landmark.category
    np.testing.assert_array_equal(new.log_votes, votes)
