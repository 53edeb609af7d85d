"""The lifecycle of landmarks and keyframes: counts and thresholds, without fits where none is tested."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam import mapping
from perception.slam.association import RenderedMasks
from perception.slam.bundle_window import BundleResult
from perception.slam.config import LandmarkLifecycleConfig, SlamConfig
from perception.slam.keyframes import Keyframe
from perception.slam.mapping import Mapper
from perception.slam.marginal_prior import ViewInformation
from perception.slam.unmatched_masks import UnmatchedMask

LIFE = LandmarkLifecycleConfig()


@pytest.fixture(scope="module")
def view(observe, T_view):
    return observe(T_view, number=10)


@pytest.fixture
def mapper(cylinders):
    """A mapper with the true map."""
    mapper = Mapper(cylinders.plane, cylinders.decoder, SlamConfig())
    mapper.world, mapper.next_id = cylinders.map(), 5
    return mapper


@pytest.fixture
def fits(mapper, cylinders, monkeypatch):
    """Replace the fit by the true landmark under a mask; return requests, masks and ids of the truth."""
    requests, masks, ids = [], [], []

    def fit(views, *args):
        requests.append(views)
        overlaps = [(views.detection.mask & mask).sum() for mask in masks]
        landmark = cylinders.landmark(ids[int(np.argmax(overlaps))])
        return replace(landmark, id=views.id, category=views.detection.category)

    monkeypatch.setattr(mapping, "initialise_landmark", fit)
    return requests, masks, ids


def change(mapper, id, **changes):
    mapper.world = mapper.world.with_landmarks(replace(mapper.world.landmarks[id], **changes))


def rendering(visible, unoccluded, see_through=()):
    """Rendered masks that report numbers of pixels alone, at a pitch of four."""
    ids = np.full((60, 80), -1)
    for k, id in enumerate(see_through):
        ids[k] = id
    depth = np.where(ids >= 0, 0.1, 0.0)  # everything measured lies behind
    return RenderedMasks(ids, depth, np.zeros((60, 80)), unoccluded, visible, 4)


def test_detected_landmarks_get_hits_and_others_keep_their_counts(mapper, view):
    partial = view.without_landmarks({0})
    assert mapper.update_landmarks(partial, None, {}) == set()
    n_hits = {id: landmark.n_hits for id, landmark in mapper.world.landmarks.items()}
    assert n_hits == {0: 1, 1: 2, 2: 2, 3: 2, 4: 2}


@pytest.mark.parametrize(("extra", "retired"), [(0, set()), (1, {0})])
def test_landmarks_are_retired_beyond_each_limit(mapper, view, extra, retired):
    for changes in (
        {"n_misses": LIFE.max_misses - 1 + extra, "n_hits": 9},
        {"n_outlier_frames": LIFE.max_outlier_frames + extra},
        {"n_see_through": LIFE.max_see_through + extra},
    ):
        world = mapper.world
        change(mapper, 0, **changes)
        # the first case counts one more miss: expected in view, but without a mask
        rendered = rendering({0: 20}, {0: 20}) if "n_misses" in changes else None
        assert mapper.update_landmarks(view.without_landmarks({0}), rendered, {}) == retired
        assert (0 in mapper.world.ids) != bool(retired)
        mapper.world = world


def test_see_through_checks_count_in_a_row(mapper, view):
    seen_through = rendering({}, {}, see_through=[0])
    mapper.update_landmarks(view, seen_through, {})
    assert [mapper.world.landmarks[id].n_see_through for id in range(5)] == [1, 0, 0, 0, 0]
    solid = replace(seen_through, depth=np.where(seen_through.landmark_ids >= 0, 10.0, 0.0))
    mapper.update_landmarks(view, solid, {})  # occluded: not judged
    assert mapper.world.landmarks[0].n_see_through == 1


def test_ages_belong_to_labels_even_if_masks_are_equal(mapper, view, fits, cylinders):
    """Two detections that share one mask array: only the label that has waited is initialised."""
    requests, masks, ids = fits
    found = view.detections[0]
    masks.append(found.mask), ids.append(0)
    twins = replace(view, detections=[found, found], landmark_of={})
    mapper.world = mapper.world.without(set(mapper.world.ids))
    mapper.unmatched = {1: UnmatchedMask(found.mask, 1), 2: UnmatchedMask(found.mask, 2)}
    assert mapper.initialise_landmarks(twins, supported=False) == {2: 5}
    assert len(requests) == 1


@pytest.mark.parametrize(
    ("age", "tried", "initialised"),
    [(1, None, False), (2, None, True), (3, 9, False), (9, 3, False), (9, 2, True)],
)
def test_masks_wait_and_are_retried_at_intervals(mapper, view, fits, age, tried, initialised):
    """The frame has number 10, the interval is 8."""
    _, masks, ids = fits
    masks.append(view.detections[0].mask), ids.append(view.landmark_of[1])
    mapper.world = mapper.world.without({view.landmark_of[1]})
    mapper.unmatched = {1: UnmatchedMask(view.detections[0].mask, age, tried)}
    new = mapper.initialise_landmarks(view.without_landmarks({view.landmark_of[1]}), supported=True)
    assert new == ({1: 5} if initialised else {}) and mapper.next_id == (6 if initialised else 5)
    assert (5 in mapper.world.ids) == initialised


def test_a_landmark_that_coincides_with_another_is_not_added(mapper, view, fits):
    _, masks, ids = fits
    masks.append(view.detections[0].mask), ids.append(view.landmark_of[1])
    mapper.unmatched = {1: UnmatchedMask(view.detections[0].mask, 2)}
    assert mapper.initialise_landmarks(view.without_landmarks({view.landmark_of[1]}), False) == {}
    assert mapper.next_id == 5


def test_support_counts_agreeing_landmarks(mapper):
    assert mapper.has_enough_support({0: 0.61, 1: 0.61, 2: 0.61, 3: 0.1})
    assert not mapper.has_enough_support({0: 0.61, 1: 0.61, 2: 0.6})


@pytest.mark.parametrize(
    ("number", "weak", "unseen", "expected"),
    [(7, False, 0.31, False), (8, False, 0.31, True), (8, False, 0.3, False), (2, True, 0.31, True)],
)
def test_unseen_parts_make_a_keyframe_at_intervals(mapper, view, number, weak, unseen, expected):
    mapper.keyframes = [Keyframe.of(replace(view, number=0), np.eye(6))]
    assert mapper.reveals_unseen_parts(replace(view, number=number), {0: unseen}, weak) == expected
    mapper.keyframes = []
    assert not mapper.reveals_unseen_parts(replace(view, number=number), {0: unseen}, weak)


def test_moved_and_no_longer_truncated_objects_make_a_keyframe(mapper, view):
    mapper.keyframes = [Keyframe.of(replace(view, number=0), np.eye(6))]
    assert not mapper.reveals_unseen_parts(view, {}, False)
    change(mapper, 1, n_outlier_frames=LIFE.refit_after_outlier_frames - 1)
    assert not mapper.reveals_unseen_parts(view, {}, False)
    change(mapper, 1, n_outlier_frames=LIFE.refit_after_outlier_frames)
    assert mapper.reveals_unseen_parts(view, {}, False)
    change(mapper, 1, n_outlier_frames=0, truncated=True)
    assert mapper.reveals_unseen_parts(view, {}, False)
    label = next(label for label, id in view.landmark_of.items() if id == 1)
    labels = np.array(view.labels)
    labels[0] = label
    assert not mapper.reveals_unseen_parts(replace(view, labels=labels), {}, False)


def test_keyframes_set_the_covariance_of_new_and_of_worse_known_landmarks(mapper, view):
    sure, vague = 1e-8 * np.eye(6), 1e-2 * np.eye(6)
    key = Keyframe.of(view, vague)
    before = mapper.world.landmarks[1].covariance
    mapper.add_keyframe(key, np.zeros((0, 3)), new=[0])
    np.testing.assert_array_equal(mapper.world.landmarks[1].covariance, before)
    expected = mapper.world.landmarks[0].covariance_from(key.T_world_camera, vague)
    np.testing.assert_allclose(mapper.world.landmarks[0].covariance, expected)
    better = replace(Keyframe.of(replace(view, number=11), sure))
    mapper.add_keyframe(better, np.zeros((0, 3)), new=[])
    improved = mapper.world.landmarks[0].covariance
    assert np.trace(improved[3:, 3:]) < np.trace(expected[3:, 3:])


def test_the_oldest_keyframes_and_their_information_are_dropped(mapper, view):
    mapper.config = replace(mapper.config, lifecycle=replace(LIFE, max_keyframes=2))
    state = mapper.world.landmarks[0].state
    for number in range(3):
        mapper._information[number, 0] = ViewInformation(state, np.eye(25))
        mapper._information[number, 99] = ViewInformation(state, np.eye(25))
        mapper.add_keyframe(Keyframe.of(replace(view, number=number), np.eye(6)), np.zeros((1, 3)), [])
    assert [key.number for key in mapper.keyframes] == [1, 2]
    assert set(mapper._plane_points) == {1, 2} and set(mapper._information) == {(1, 0), (2, 0)}


@pytest.fixture
def stale(mapper, view, fits):
    """Return a function that refits the newest keyframe's landmarks and returns the ids that were fitted."""
    requests, masks, ids = fits
    for label, id in view.landmark_of.items():
        masks.append(view.labels == label), ids.append(id)
    key = Keyframe.of(view, 1e-6 * np.eye(6))
    mapper.keyframes = [key]

    def refitted(unseen=None):
        requests.clear()
        result = mapper.refit_stale(key, unseen or {})
        return [request.id for request in requests], result

    return refitted


def test_sound_landmarks_are_not_refitted(stale):
    assert stale()[0] == []


def test_another_class_with_enough_votes_is_refitted(mapper, stale):
    votes = np.zeros(4)
    votes[0] = LIFE.class_log_odds
    change(mapper, 2, log_votes=votes)
    assert stale()[0] == []
    change(mapper, 2, log_votes=1.01 * votes)
    assert stale()[0] == [2] and mapper.world.landmarks[2].category == "mug"
    assert mapper.world.landmarks[2].n_updates == 2


def test_truncated_landmarks_are_refitted_when_fully_visible_or_much_is_new(mapper, stale, view):
    change(mapper, 3, truncated=True)
    assert stale()[0] == [3] and not mapper.world.landmarks[3].truncated
    assert stale({3: 0.9})[0] == []  # not truncated any more


def test_one_landmark_is_refitted_at_a_time_the_most_revealed_first(mapper, stale):
    for id in (1, 2):
        change(mapper, id, truncated=True)
    assert stale({2: 0.5})[0] == [2]
    assert stale({2: 0.5})[0] == [1]


def test_moved_landmarks_lose_their_older_views(mapper, stale, view):
    newest = mapper.keyframes[0]
    old = Keyframe.of(replace(view, number=3), np.eye(6))
    mapper.keyframes = [old, newest]
    pose = mapper.world.landmarks[4].state.pose
    away = replace(pose, translation=pose.translation + np.array([0.031, 0, 0]))
    state = replace(mapper.world.landmarks[4].state, pose=away)
    change(mapper, 4, state=state, n_outlier_frames=LIFE.refit_after_outlier_frames)
    mapper._information[3, 4] = mapper._information[3, 0] = ViewInformation(state, np.eye(25))
    assert stale()[0] == [4]  # once, to the newest view
    assert 4 not in mapper.keyframes[0].landmark_ids and 4 in mapper.keyframes[1].landmark_ids
    assert set(mapper._information) == {(3, 0)}
    np.testing.assert_allclose(mapper.world.landmarks[4].state.pose.translation, pose.translation)


def test_landmarks_displaced_less_keep_their_views(mapper, stale, view):
    newest = mapper.keyframes[0]
    mapper.keyframes = [Keyframe.of(replace(view, number=3), np.eye(6)), newest]
    change(mapper, 4, n_outlier_frames=LIFE.refit_after_outlier_frames)
    assert stale()[0] == [4, 4]  # to the newest view, then to all
    assert all(4 in key.landmark_ids for key in mapper.keyframes)


def test_disagreeing_landmarks_are_left_out_of_the_optimisation(mapper, stale):
    change(mapper, 1, n_outlier_frames=1)
    change(mapper, 2, n_outlier_frames=1, truncated=True)
    _, key = stale()
    # landmark 2 was refitted as it is fully visible; landmark 1 still disagrees
    assert key.landmark_ids == {0, 2, 3, 4} and mapper.keyframes[0].landmark_ids == {0, 2, 3, 4}


def test_optimisation_uses_priors_from_outside_the_window_and_returns_the_correction(mapper, view):
    T_correction = np.eye(4)
    T_correction[0, 3] = 0.1
    for number in (7, 8, 9, 10):
        key = Keyframe.of(replace(view, number=number), np.eye(6))
        mapper.add_keyframe(key, np.full((1, 3), float(number)), [])
        mapper._information[number, 0] = ViewInformation(mapper.world.landmarks[0].state, np.eye(25))
    window = mapper.window_of(key)
    moved = tuple(key.with_pose(T_correction @ key.T_world_camera) for key in window.keyframes)
    information = {(10, 0): ViewInformation(window.landmarks[0].state, 5 * np.eye(25))}
    result = BundleResult(moved, {}, information, 1.0, 0.5, 3)
    np.testing.assert_allclose(mapper.apply(result), T_correction, atol=1e-12)
    numbers = [key.number for key in window.keyframes]
    assert len(numbers) == 3 and numbers[-1] == 10
    assert [points[0, 0] for points in window.plane_points] == numbers
    assert set(window.priors) == {0}
    np.testing.assert_array_equal(window.priors[0].information, np.eye(25))  # of the one keyframe outside
    assert mapper._information[10, 0].information[0, 0] == 5
    moved = {key.number: key.T_world_camera[0, 3] - view.T_world_camera[0, 3] for key in mapper.keyframes}
    assert moved == pytest.approx({n: 0.1 if n in numbers else 0.0 for n in (7, 8, 9, 10)})


def test_what_changed_during_the_optimisation_is_kept(mapper, view):
    key = Keyframe.of(view, np.eye(6))
    mapper.add_keyframe(key, np.zeros((1, 3)), [])
    states = {id: replace(x.state, code=x.state.code + 0.5) for id, x in mapper.world.landmarks.items()}
    optimised = {
        id: replace(x.with_state(states[id]), n_updates=2) for id, x in mapper.world.landmarks.items()
    }
    mapper.world = mapper.world.without({0})
    change(mapper, 1, n_hits=7)
    information = {(10, id): ViewInformation(states[id], np.eye(25)) for id in (0, 1)}
    mapper.apply(BundleResult((key,), optimised, information, 1.0, 0.5, 3))
    assert mapper.world.ids == (1, 2, 3, 4) and set(mapper._information) == {(10, 1)}
    landmark = mapper.world.landmarks[1]
    assert (landmark.n_hits, landmark.n_updates, landmark.state) == (7, 2, states[1])


def test_new_masks_outliers_and_misses_ask_for_detections(mapper, view):
    assert not mapper.needs_detections and not mapper.verifies_absence
    mapper.unmatched = {1: UnmatchedMask(view.detections[0].mask, LIFE.min_frames_unmatched)}
    assert not mapper.needs_detections
    mapper.unmatched = {1: UnmatchedMask(view.detections[0].mask, LIFE.min_frames_unmatched - 1)}
    assert mapper.needs_detections
    mapper.unmatched = {}
    change(mapper, 1, n_misses=1)
    assert mapper.verifies_absence and not mapper.needs_detections
    change(mapper, 1, n_outlier_frames=1)
    assert mapper.needs_detections
