"""Instance segmentation: Hough voting on synthetic predictions; the shipped network on rendered scenes."""

from types import SimpleNamespace

import numpy as np
import pytest

from perception.detection.instances import (
    InstanceConfig,
    ScenePrediction,
    _plausible,
    assign_pixels,
    decode_prediction,
    find_instances,
    find_peaks,
    remove_specks,
    upsample_labels,
)
from perception.detection.instances import segment as segment_instances
from perception.detection.predictors import load_scene_predictor
from perception.detection.tasks import CLASSES, SCENE_OUTPUTS, VOTE_UNIT
from perception.detection.working_view import downscale, working_view
from perception.types import RgbdFrame, SupportPlane

PLANE = SupportPlane()
TARGET = (0.48, -0.22, 0.05)
CONFIG = InstanceConfig()


def perfect(frame, instances, places, noise=0.0):
    """Return the outputs (h/2, w/2, 12) of a perfect network, from the true instance of each pixel."""
    view = working_view(frame, PLANE)
    rng = np.random.default_rng(0)
    h, w = instances.shape
    answer = np.zeros((h // 2, w // 2, SCENE_OUTPUTS), np.float32)
    quarters = (instances >= 0).reshape(h // 2, 2, w // 2, 2).transpose(0, 2, 1, 3)
    answer[..., :4] = np.where(quarters.reshape(h // 2, w // 2, 4), 8, -8)
    coarse = instances[::2, ::2]
    answer[..., 4 + 2] = 5.0  # bottles, all of them
    target = (np.array(places) @ view.axes[:, :2].T)[np.maximum(coarse, 0)]
    target = target + noise * rng.standard_normal(target.shape)
    offset = (target - view.plan[::2, ::2]) / view.pixel[::2, ::2, None] / VOTE_UNIT
    answer[..., 4 + CLASSES : 6 + CLASSES] = np.where(coarse[..., None] >= 0, offset, 0)
    answer[..., 6 + CLASSES] = np.log(max(100 * noise, 0.1))
    return answer


class Oracle:
    """Predicts what it is given."""

    def __init__(self, answer):
        self.fixed = answer

    def __call__(self, channels):
        return self.fixed


@pytest.fixture
def touching(scenes):
    """Three cylinders in contact, and one apart."""
    places = [(0.40, -0.25), (0.47, -0.25), (0.435, -0.19), (0.56, -0.15)]
    solids = [scenes.Solid(x, y, 0.10 + 0.02 * k, radius=0.035) for k, (x, y) in enumerate(places)]
    scene = scenes.render(solids, scenes.orbit(TARGET, 0.55, 50, 70), 0.001, size=(320, 240))
    return SimpleNamespace(frame=scene.frame, instances=scene.instances, places=places)


@pytest.mark.parametrize("noise", [0.0, 0.006])
def test_objects_in_contact_are_separated_by_their_votes(touching, noise):
    frame = downscale(touching.frame)
    network = Oracle(perfect(frame, touching.instances, touching.places, noise))
    found = find_instances(frame, PLANE, network)
    assert len(found) == 4
    for k in range(4):
        true = touching.instances == k
        overlap = max((f.mask & true).sum() / (f.mask | true).sum() for f in found)
        assert overlap > (0.97 if noise == 0 else 0.93)
    assert sum(f.mask.astype(int) for f in found).max() == 1  # no pixel twice
    assert all(f.log_classes.argmax() == 2 for f in found)


def test_peaks_are_at_the_footprints(touching):
    frame = downscale(touching.frame)
    view = working_view(frame, PLANE)
    answer = decode_prediction(perfect(frame, touching.instances, touching.places, 0.004), view)
    peaks = find_peaks(answer, view, CONFIG) @ view.axes[:, :2]
    assert len(peaks) == 4
    for place in touching.places:
        assert np.linalg.norm(peaks - place, axis=1).min() < 0.004


def test_uncertain_votes_make_no_peak(touching):
    frame = downscale(touching.frame)
    view = working_view(frame, PLANE)
    answer = decode_prediction(perfect(frame, touching.instances, touching.places), view)
    doubtful = ScenePrediction(answer.foreground, answer.log_classes, answer.vote, answer.spread + 1.0)
    assert len(find_peaks(doubtful, view, CONFIG)) == 0
    nothing = ScenePrediction(0 * answer.foreground, answer.log_classes, answer.vote, answer.spread)
    assert len(find_peaks(nothing, view, CONFIG)) == 0


def test_small_components_are_assigned_to_the_surrounding_instance(touching):
    frame = downscale(touching.frame)
    view = working_view(frame, PLANE)
    answer = decode_prediction(perfect(frame, touching.instances, touching.places), view)
    peaks = find_peaks(answer, view, CONFIG)
    clean = assign_pixels(answer, view, peaks, CONFIG)
    vote = answer.vote.copy()
    v, u = (int(c.mean()) // 2 for c in np.nonzero(touching.instances == 3))
    vote[v - 1 : v + 2, u - 1 : u + 2] = peaks[np.argmax(np.linalg.norm(peaks - vote[v, u], axis=1))]
    strayed = ScenePrediction(answer.foreground, answer.log_classes, vote, answer.spread)
    assert (assign_pixels(strayed, view, peaks, CONFIG) == clean)[touching.instances == 3].mean() > 0.99


def test_an_object_without_a_peak_becomes_background(touching):
    """The lone cylinder's votes are doubtful and make no peak; no other one takes it in."""
    frame = downscale(touching.frame)
    view = working_view(frame, PLANE)
    answer = decode_prediction(perfect(frame, touching.instances, touching.places), view)
    lone = touching.instances == 3
    answer.spread[lone[::2, ::2]] += 1.0
    peaks = find_peaks(answer, view, CONFIG)
    assert len(peaks) == 3
    numbers = assign_pixels(answer, view, peaks, CONFIG)
    assert (numbers[lone] == -1).mean() > 0.95 and (numbers[touching.instances == 1] >= 0).all()

    vote = answer.vote.copy()  # not as far astray: a separate piece is judged as a whole
    away = peaks[0] - peaks[1:].mean(0)
    vote[lone[::2, ::2]] = peaks[0] + 0.045 * away / np.linalg.norm(away)
    numbers = assign_pixels(
        ScenePrediction(answer.foreground, answer.log_classes, vote, answer.spread), view, peaks, CONFIG
    )
    assert (numbers[lone] == -1).mean() > 0.95


def test_labels_are_upsampled_to_the_frame():
    foreground, numbers = np.zeros((24, 32), np.float32), np.zeros((24, 32), np.int32)
    foreground[6:18, 8:24], numbers[:, 16:] = 1.0, 1
    full = upsample_labels(foreground, numbers, (48, 64), CONFIG)
    assert set(np.unique(full)) == {-1, 0, 1}
    assert abs((full == 0).sum() - 4 * 96) < 0.15 * 4 * 96


def test_specks_are_removed_and_large_parts_kept():
    mask = np.zeros((60, 80), bool)
    mask[5:25, 10:30] = mask[35:50, 10:30] = True  # parted by something in front of it
    mask[55, 70:73] = True
    clean = remove_specks(mask, 0.03)
    assert not clean[55].any() and clean.sum() == mask.sum() - 3
    assert remove_specks(mask, 0.0).sum() == mask.sum()


def test_an_instance_above_the_height_limit_is_left_out(scenes):
    scene = scenes.render(
        [scenes.Solid(0.45, -0.2, 0.6, half=(0.04, 0.04))], scenes.orbit(TARGET, 1.0, 30, 0)
    )
    network = Oracle(perfect(downscale(scene.frame), scene.instances, [(0.45, -0.2)]))
    assert find_instances(scene.frame, PLANE, network) == []


def test_no_depth_no_instances(scenes):
    frame = scenes.render([], scenes.orbit(TARGET, 0.5, 60, 0)).frame
    blind = RgbdFrame(0.0, frame.rgb, 0 * frame.depth, frame.intrinsics, frame.T_world_camera)
    assert find_instances(blind, PLANE, load_scene_predictor()) == []


def test_pixels_with_scattered_votes_are_background(touching):
    frame = downscale(touching.frame)
    answer = perfect(frame, touching.instances, touching.places)
    corner = np.s_[:8, :16]  # no thing is there: a wall that the network takes for one, without knowing where
    assert (touching.instances[:16, :32] < 0).all()
    answer[corner][..., :4] = 8
    scattered = np.random.default_rng(0).uniform(0.3, 1.0, (8, 16, 2)) / VOTE_UNIT
    answer[corner][..., 4 + CLASSES : 6 + CLASSES] = (
        scattered / working_view(frame, PLANE).pixel[:16:2, :32:2, None]
    )
    found = find_instances(frame, PLANE, Oracle(answer))
    alone = find_instances(frame, PLANE, Oracle(perfect(frame, touching.instances, touching.places)))
    assert len(found) == len(alone) == 4
    assert not any(f.mask[:14, :28].any() for f in found)


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"min_pixels": 100_000}, "too small"),
        ({"min_area": 1.0}, "too small"),
        ({"max_height": 0.05}, "too high"),
        ({"min_distance": 2.0}, "too near"),
    ],
)
def test_implausible_instances_are_returned_with_the_reason(touching, limits, reason):
    frame = downscale(touching.frame)
    network = Oracle(perfect(frame, touching.instances, touching.places))
    kept, left_out = segment_instances(frame, PLANE, network, InstanceConfig(**limits))
    assert not kept and [c.reason for c in left_out] == 4 * [reason]
    assert all(candidate.detail for candidate in left_out)
    assert sum(c.mask.astype(int) for c in left_out).max() == 1


def test_an_instance_without_depth_is_left_out(touching):
    depth = np.where(touching.instances == 3, 0, touching.frame.depth)
    f = touching.frame
    blind = RgbdFrame(0.0, f.rgb, depth, f.intrinsics, f.T_world_camera)
    kept, left_out = _plausible(touching.instances, np.zeros((4, CLASSES)), blind, PLANE, CONFIG)
    assert len(kept) == 3 and [c.reason for c in left_out] == ["no depth"]


# --- the shipped network on rendered scenes unlike its training data -----------------------------


@pytest.fixture(scope="module")
def segment():
    """Masks of the instances of a frame."""
    network = load_scene_predictor()

    def masks(frame, plane, config=None):
        found = find_instances(frame, plane, network, config or InstanceConfig())
        return [instance.mask for instance in found]

    return masks


@pytest.fixture
def table(scenes):
    """A can, a bottle, a carton and a bowl-sized cylinder, 4 cm and more apart."""
    return [
        scenes.Solid(0.40, -0.30, 0.10, radius=0.04),
        scenes.Solid(0.52, -0.30, 0.20, radius=0.035),
        scenes.Solid(0.40, -0.18, 0.05, half=(0.05, 0.03)),
        scenes.Solid(0.53, -0.14, 0.07, radius=0.06),
    ]


def matches(masks, instances, count):
    """Best IoU for each true instance."""
    return [
        max(((m & (instances == i)).sum() / (m | (instances == i)).sum() for m in masks), default=0.0)
        for i in range(count)
    ]


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("view", [(90, 0, 0.6), (60, 90, 0.5), (45, 200, 0.5), (75, 300, 0.45)])
def test_every_object_is_one_instance(segment, scenes, table, view, noise):
    elevation, azimuth, distance = view
    scene = scenes.render(table, scenes.orbit(TARGET, distance, elevation, azimuth), noise, size=(640, 480))
    masks = segment(scene.frame, PLANE)
    assert len(masks) == len(table)
    assert min(matches(masks, scene.instances, len(table))) > 0.87
    assert sum(m.astype(int) for m in masks).max() == 1  # no pixel twice


def test_masks_are_rather_too_large(segment, scenes, table):
    scene = scenes.render(table, scenes.orbit(TARGET, 0.5, 60, 90), 0.002, size=(640, 480))
    for mask in segment(scene.frame, PLANE):
        true = scene.instances == np.bincount(scene.instances[mask & (scene.instances >= 0)]).argmax()
        assert (mask & true).sum() > 0.97 * true.sum()


def test_an_open_box_does_not_affect_its_neighbours(segment, scenes, table):
    walls = [scenes.Solid(0.5, y, 0.08, half=(0.18, 0.003)) for y in (0.12, 0.42)]
    walls += [scenes.Solid(x, 0.27, 0.08, half=(0.003, 0.15)) for x in (0.32, 0.68)]
    floor = scenes.Solid(0.5, 0.27, 0.004, half=(0.18, 0.15))
    scene = scenes.render([*table, *walls, floor], scenes.orbit(TARGET, 0.6, 50, 270), 0.002, size=(640, 480))
    assert (scene.instances >= len(table)).sum() > 5000  # it is in view
    assert min(matches(segment(scene.frame, PLANE), scene.instances, len(table))) > 0.9


def test_an_object_half_hidden_is_not_joined_to_what_hides_it(segment, scenes):
    solids = [scenes.Solid(0.45, -0.30, 0.12, radius=0.03), scenes.Solid(0.45, -0.18, 0.09, radius=0.04)]
    scene = scenes.render(solids, scenes.orbit((0.45, -0.25, 0.05), 0.5, 45, 270), 0.002, size=(640, 480))
    masks = segment(scene.frame, PLANE)
    assert len(masks) == 2
    assert min(matches(masks, scene.instances, 2)) > 0.85


def test_truncated_objects_are_found(segment, scenes, table):
    scene = scenes.render(table, scenes.orbit((0.40, -0.30, 0.05), 0.25, 80, 90), size=(640, 480))
    masks = segment(scene.frame, PLANE)
    edge = [m for m in masks if m[0].any() or m[-1].any() or m[:, 0].any() or m[:, -1].any()]
    assert edge


def test_holes_in_the_depth_are_part_of_the_mask(segment, scenes):
    scene = scenes.render([scenes.Solid(0.45, -0.2, 0.1, radius=0.05)], scenes.orbit(TARGET, 0.5, 60, 0))
    depth = scene.frame.depth.copy()
    v, u = (int(c.mean()) for c in np.nonzero(scene.instances == 0))
    depth[v - 4 : v + 4, u - 4 : u + 4] = 0
    frame = RgbdFrame(0.0, scene.frame.rgb, depth, scene.frame.intrinsics, scene.frame.T_world_camera)
    (mask,) = segment(frame, PLANE)
    assert mask[v - 4 : v + 4, u - 4 : u + 4].all()


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_bare_table_has_no_instances(segment, scenes, noise):
    assert segment(scenes.render([], scenes.orbit(TARGET, 0.5, 60, 0), noise).frame, PLANE) == []


def test_the_shipped_network_finds_nothing_without_depth(segment, scenes):
    frame = scenes.render([], scenes.orbit(TARGET, 0.5, 60, 0)).frame
    blind = RgbdFrame(0.0, frame.rgb, 0 * frame.depth, frame.intrinsics, frame.T_world_camera)
    assert segment(blind, PLANE) == []


def test_instances_that_are_too_high_or_too_near_are_left_out(segment, scenes):
    arm = scenes.Solid(0.45, -0.2, 0.6, half=(0.04, 0.04))
    scene = scenes.render([arm], scenes.orbit(TARGET, 1.0, 30, 0))
    assert segment(scene.frame, PLANE, InstanceConfig(max_height=0.3)) == []
    finger = scenes.Solid(0.48, -0.22, 0.45, radius=0.01)
    scene = scenes.render([finger], scenes.orbit(TARGET, 0.5, 90, 0))
    assert segment(scene.frame, PLANE, InstanceConfig(max_height=1.0)) == []


def test_a_camera_without_pose_gives_the_same_masks(segment, scenes, table):
    T = scenes.orbit(TARGET, 0.5, 60, 90)
    frame = scenes.render(table, T).frame
    alone = RgbdFrame(0.0, frame.rgb, frame.depth, frame.intrinsics)
    plane = SupportPlane(normal=T[:3, :3].T @ (0.0, 0.0, 1.0), offset=float(-T[2, 3]))
    posed, unposed = segment(frame, PLANE), segment(alone, plane)
    assert len(posed) == len(unposed) == len(table)
    for mask in posed:
        assert max((mask & other).sum() / (mask | other).sum() for other in unposed) > 0.98
