"""Masks to landmarks by overlap and place; parts of one vessel; viewpoints and windows of keyframes."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import transform_points
from perception.slam.association import associate_masks, render_masks, seen_through
from perception.slam.keyframes import (
    NEW_VIEW,
    make_keyframe,
    shows_new_view,
    view_angle,
    window_of,
    with_pose,
)
from perception.slam.landmarks import doubles
from perception.slam.mask_merging import FragmentConfig, touching, unite_fragments
from perception.slam.pixels import SelectionConfig, in_known_parts, label_image, select_pixels
from perception.types import ObjectDetection, SupportPlane


@pytest.fixture
def view(cylinders, scenes):
    T = scenes.orbit((0, 0.03, 0.03), 0.55, 45, 20)
    frame, detections, shown = cylinders.look(T)
    return T, frame, detections, shown, label_image(detections, frame.depth.shape)


def test_rendered_masks_are_the_true_ones(cylinders, view):
    T, frame, detections, shown, _ = view
    rendered = render_masks(cylinders.map(), frame, T, pitch=2)
    for found, one in zip(detections, shown):
        mask = found.mask[::2, ::2]
        both = (rendered.index == one) & mask
        assert both.sum() > 0.85 * ((rendered.index == one) | mask).sum()
        assert 0 < rendered.visible[one] <= rendered.whole[one]


def test_what_was_taken_away_is_seen_through_and_nothing_else(cylinders, view):
    T, frame, _, shown, _ = view
    whole = seen_through(render_masks(cylinders.map(), frame, T), frame)
    assert set(whole) == set(shown) and max(whole.values()) < 0.2
    emptier = replace(cylinders, places=cylinders.places[1:])
    frame, _, _ = emptier.look(T)
    shares = seen_through(render_masks(cylinders.map(), frame, T), frame)
    assert shares[0] > 0.8 and max(share for one, share in shares.items() if one != 0) < 0.2
    in_front = replace(frame, depth=np.full_like(frame.depth, 0.2))
    assert seen_through(render_masks(cylinders.map(), in_front, T), in_front) == {}


def test_of_two_landmarks_at_one_place_the_one_seen_more_often_stays(cylinders):
    landmarks = dict(cylinders.map().landmarks)
    assert doubles(landmarks) == set()
    landmarks[7] = replace(landmarks[1], id=7, hits=5)
    assert doubles(landmarks) == {1}
    landmarks[7] = replace(landmarks[7], hits=1)
    assert doubles(landmarks) == {7}


def test_masks_find_landmarks_by_rendering(cylinders, view):
    T, frame, _, shown, labels = view
    world = cylinders.map()
    found = associate_masks(frame, labels, None, lambda: render_masks(world, frame, T), world)
    assert found == {k + 1: one for k, one in enumerate(shown)}


def test_previous_masks_come_first_and_spare_the_rendering(cylinders, view):
    _, frame, _, shown, labels = view
    known = {k + 1: one for k, one in enumerate(shown)}

    def never():
        raise AssertionError("rendered")

    assert associate_masks(frame, labels, (labels, known), never, cylinders.map()) == known


def test_a_mask_far_from_its_landmark_is_not_believed(cylinders, view):
    T, frame, _, shown, labels = view
    swapped = {k + 1: one for k, one in enumerate(shown)}
    swapped[1], swapped[2] = swapped[2], swapped[1]
    world = cylinders.map()
    found = associate_masks(frame, labels, (labels, swapped), lambda: render_masks(world, frame, T), world)
    assert found == {k + 1: one for k, one in enumerate(shown)}


def test_parts_of_one_mask_all_belong_to_its_landmark(cylinders, view):
    T, frame, _, shown, labels = view
    rows, columns = np.nonzero(labels == 1)
    cut = np.array(labels)
    cut[rows[rows > np.quantile(rows, 0.6)], columns[rows > np.quantile(rows, 0.6)]] = 200
    world = cylinders.map()
    found = associate_masks(frame, cut, None, lambda: render_masks(world, frame, T), world)
    assert found[1] == shown[0] and found[200] == shown[0]


def halves(found: ObjectDetection) -> list[ObjectDetection]:
    """A mask cut across."""
    middle = int(np.nonzero(found.mask)[0].mean())
    top, bottom = np.array(found.mask), np.array(found.mask)
    top[middle:], bottom[:middle] = False, False
    return [ObjectDetection("mug", 0.9, top), ObjectDetection("mug", 0.8, bottom)]


def test_arcs_of_one_vessel_are_united(scenes):
    T = scenes.orbit((0, 0, 0.03), 0.5, 60, 0)
    scene = scenes.render([scenes.Solid(0, 0, 0.08, radius=0.05)], T)
    whole = ObjectDetection("mug", 0.9, scene.instances == 0)
    top, bottom = halves(whole)
    # From 60 degrees above both halves show the top face, as near wall and far wall show one rim.
    united = unite_fragments(scene.frame, [top, bottom], SupportPlane())
    assert len(united) == 1 and (united[0].mask == whole.mask).all()
    bottles = [ObjectDetection("bottle", 0.9, part.mask) for part in (top, bottom)]
    assert len(unite_fragments(scene.frame, bottles, SupportPlane())) == 2


def test_two_vessels_one_behind_the_other_stay_two(scenes):
    T = scenes.orbit((0, 0, 0.03), 0.5, 35, 0)
    solids = [scenes.Solid(0.06, 0, 0.08, radius=0.04), scenes.Solid(-0.06, 0, 0.08, radius=0.04)]
    scene = scenes.render(solids, T)
    found = [ObjectDetection("mug", 0.9, scene.instances == k) for k in (0, 1)]
    assert touching(label_image(found, scene.instances.shape), 8) == [(0, 1)]
    assert len(unite_fragments(scene.frame, found, SupportPlane())) == 2


def test_two_vessels_side_by_side_stay_two(scenes):
    T = scenes.orbit((0, 0, 0.03), 0.5, 50, 0)
    solids = [scenes.Solid(0.03, -0.032, 0.08, radius=0.04), scenes.Solid(-0.03, 0.032, 0.08, radius=0.04)]
    scene = scenes.render(solids, T)
    found = [ObjectDetection("mug", 0.9, scene.instances == k) for k in (0, 1)]
    assert touching(label_image(found, scene.instances.shape), 8) == [(0, 1)]
    assert len(unite_fragments(scene.frame, found, SupportPlane())) == 2
    careless = FragmentConfig(common=-1.0)
    assert len(unite_fragments(scene.frame, found, SupportPlane(), careless)) == 1


def test_a_small_part_may_stand_beside_the_rest(scenes):
    T = scenes.orbit((0, 0, 0.03), 0.5, 60, 0)
    scene = scenes.render([scenes.Solid(0, 0, 0.08, radius=0.05)], T)
    whole = scene.instances == 0
    edge = np.quantile(np.nonzero(whole)[1], 0.8)
    part = whole & (np.arange(whole.shape[1]) > edge)
    found = [ObjectDetection("mug", 0.9, whole & ~part), ObjectDetection("mug", 0.6, part)]
    (united,) = unite_fragments(scene.frame, found, SupportPlane())
    assert (united.mask == whole).all()


def test_angle_between_views(scenes):
    T = [scenes.orbit((0, 0, 0), 0.5, 0, azimuth) for azimuth in (10, 35)]
    assert np.degrees(view_angle(np.zeros(3), *T)) == pytest.approx(25)


def keyframe(view, number, T):
    _, frame, detections, shown, labels = view
    landmark_of = {k + 1: one for k, one in enumerate(shown)}
    return make_keyframe(number, with_pose(frame, T), T, labels, landmark_of, detections, np.eye(6))


def test_only_new_viewpoints_make_keyframes(cylinders, scenes, view):
    world = cylinders.map()
    at = [scenes.orbit((0, 0.03, 0.03), 0.55, 45, 20 + turn) for turn in (0, 4, 40)]
    kept = [keyframe(view, 0, at[0])]
    assert not shows_new_view(at[1], world.landmarks, kept)
    assert shows_new_view(at[2], world.landmarks, kept)
    assert not shows_new_view(at[2], world.landmarks, [*kept, keyframe(view, 1, at[2])])
    assert not shows_new_view(at[2], {}, kept)
    assert np.degrees(NEW_VIEW) == pytest.approx(13)


def test_the_window_holds_the_nearest_keyframes_oldest_first(cylinders, scenes, view):
    azimuths = (20, 90, 45, 160, 35)
    keys = [keyframe(view, n, scenes.orbit((0, 0.03, 0.03), 0.55, 45, a)) for n, a in enumerate(azimuths)]
    window = window_of(keys[-1], keys, cylinders.map().landmarks, 3)
    assert [key.number for key in window] == [0, 2, 4]


def test_a_point_is_in_view_where_the_image_is(view):
    T, frame, *_ = view
    key, k = keyframe(view, 0, T), frame.intrinsics
    u, v = (
        np.array([1.0, 3.0, k.width - 4.0, 40, 40, 40]),
        np.array([40, 40, 40, k.height - 2.0, k.height - 4, 40]),
    )
    depth = np.array([0.5, 0.5, 0.5, 0.5, 0.5, -0.5])  # the last one is behind the camera
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(6)], axis=1)
    points = transform_points(T, rays * depth[:, None])
    assert key.has_in_view(points).tolist() == [False, True, True, False, True, False]


def test_what_no_keyframe_had_in_view_of_a_cut_landmark_says_nothing(cylinders, scenes, view):
    T, frame, _detections, shown, labels = view
    k = frame.intrinsics
    world = cylinders.map()
    world = world.with_landmarks(replace(world.landmarks[0], cut=True))
    pixels = select_pixels(
        frame, labels, {n + 1: one for n, one in enumerate(shown)}, T, cylinders.plane, SelectionConfig()
    )
    column = pixels.directions[:, 0] * k.fx + k.cx
    own = pixels.owner == 0
    shift = np.median(column[own & pixels.is_object]) - (
        k.width - 3
    )  # so many columns to the left is its half
    narrow = replace(
        k, cx=k.cx - shift
    )  # a keyframe at the same place whose image ends in the object's middle
    key = keyframe(view, 0, T)
    key = replace(key, frame=replace(key.frame, intrinsics=narrow))
    known = in_known_parts(pixels, world, [key], T)
    assert known[~own].all()  # of the others everything was seen
    seen = column - shift <= k.width - 3
    assert (known[own & pixels.is_object] == seen[own & pixels.is_object]).mean() > 0.98
    assert 0.3 < known[own & pixels.is_object].mean() < 0.7
    both = in_known_parts(pixels, world, [key, keyframe(view, 1, T)], T)
    assert both.all()
    assert pixels.only(known).owner.tolist() == pixels.owner[known].tolist()
