"""Instance segmentation by Hough voting from the scene network's dense predictions.

Votes for footprints are accumulated on a grid in the support plane, each weighted by its predicted accuracy.
Peaks are object footprints, and every pixel is assigned to the peak nearest to its vote. Objects in contact
have separate footprints, so they are separated although they form one connected region.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist
from scipy.special import expit, log_softmax

from perception.detection.geometry import bounding_window, height_image
from perception.detection.left_out import LeftOut
from perception.detection.predictors import ScenePredictor
from perception.detection.table_margin import plan_image, without_table
from perception.detection.tasks import CLASSES, VOTE_UNIT
from perception.detection.working_view import WorkingView, downscale, fill_from_nearest, working_view
from perception.types import RgbdFrame, SupportPlane

_CENTIMETRE = 0.01
_BACKGROUND = -1


@dataclass(frozen=True)
class InstanceConfig:
    """Parameters of the instance segmentation.

    Attributes:
        min_foreground: Smallest foreground probability of a pixel; below one half, so that masks err
            outwards.
        cell: Side of the cells of the vote grid, in metres.
        vote_std: Standard deviation of the smoothing of the vote grid, in metres.
        min_peak_distance: Smallest distance between two footprints, in metres.
        max_vote_distance: Largest distance of a vote from its footprint, in metres; pixels with farther votes
            are background: parts of an object without a peak must not be assigned to a neighbour.
        max_piece_distance: The same for the median of the votes of a separate component, in metres.
        min_votes: Smallest weight of a peak: visible area perpendicular to the rays, discounted by the
            predicted errors of the votes, in square metres.
        min_area: Smallest visible area of an instance, in square metres.
        min_pixels: Smallest number of pixels of an instance.
        max_height: Largest height of an instance above the plane, in metres; excludes a robot arm.
        min_distance: Smallest mean depth of an instance, in metres; excludes the gripper.
        min_piece_share: Smallest separate component of a mask, as a share of its largest.
    """

    min_foreground: float = 0.42
    cell: float = 0.005
    vote_std: float = 0.008
    min_peak_distance: float = 0.03
    max_vote_distance: float = 0.06
    max_piece_distance: float = 0.03
    min_votes: float = 1e-4
    min_area: float = 2.5e-4
    min_pixels: int = 60
    max_height: float = 0.40
    min_distance: float = 0.15
    min_piece_share: float = 0.03


@dataclass(frozen=True)
class Instance:
    """One segmented object.

    Attributes:
        mask: (H, W) bool.
        log_classes: (5,) mean class log-probabilities over its pixels.
    """

    mask: Bool[np.ndarray, "h w"]
    log_classes: Float[np.ndarray, "5"]


@dataclass(frozen=True)
class ScenePrediction:
    """The scene network's predictions in metric units, for a working view of size (h, w).

    Attributes:
        foreground: (h, w) probability that a pixel shows an object or distractor.
        log_classes: (h/2, w/2, 5) class log-probabilities.
        vote: (h/2, w/2, 2) footprint that each pixel votes for, in plan coordinates, in metres.
        spread: (h/2, w/2) predicted error of the vote, in metres.
    """

    foreground: Float[np.ndarray, "h w"]
    log_classes: Float[np.ndarray, "h2 w2 5"]
    vote: Float[np.ndarray, "h2 w2 2"]
    spread: Float[np.ndarray, "h2 w2"]


def find_instances(
    frame: RgbdFrame,
    plane: SupportPlane,
    network: ScenePredictor,
    config: InstanceConfig = InstanceConfig(),
) -> list[Instance]:
    """Return the plausible instances of ``segment``."""
    return segment(frame, plane, network, config)[0]


def segment(
    frame: RgbdFrame,
    plane: SupportPlane,
    network: ScenePredictor,
    config: InstanceConfig = InstanceConfig(),
) -> tuple[list[Instance], list[LeftOut]]:
    """Segment the objects and distractors on the plane; masks do not overlap.

    Args:
        frame: RGB-D image; without a pose its camera is the world.
        plane: Support plane in the world frame.
        network: Scene network.
        config: Parameters.

    Returns:
        The plausible instances, largest first, and the others with the reason.
    """
    small = downscale(frame)
    if not (small.depth > 0).any():
        return [], []
    view = working_view(small, plane)
    answer = decode_prediction(network(view.channels), view)
    peaks = find_peaks(answer, view, config)
    if not len(peaks):
        return [], []
    numbers = assign_pixels(answer, view, peaks, config)
    classes = _classes(answer, numbers, len(peaks))
    numbers = np.rot90(numbers, -view.turns)
    foreground = np.rot90(answer.foreground, -view.turns)
    full = upsample_labels(foreground, numbers, frame.depth.shape, config)
    return _plausible(full, classes, frame, plane, config)


def decode_prediction(answer: Float[np.ndarray, "h2 w2 12"], view: WorkingView) -> ScenePrediction:
    """Convert the network's outputs to probabilities and votes in metres."""
    h, w = view.height.shape
    quarters = expit(answer[..., :4]).reshape(*answer.shape[:2], 2, 2)
    foreground = quarters.transpose(0, 2, 1, 3).reshape(2 * answer.shape[0], 2 * answer.shape[1])[:h, :w]
    plan, pixel = view.plan[::2, ::2], view.pixel[::2, ::2]
    vote = plan + VOTE_UNIT * answer[..., 4 + CLASSES : 6 + CLASSES] * pixel[..., None]
    spread = _CENTIMETRE * np.exp(np.clip(answer[..., 6 + CLASSES], -4, 4))
    return ScenePrediction(foreground, log_softmax(answer[..., 4 : 4 + CLASSES], axis=-1), vote, spread)


def find_peaks(
    answer: ScenePrediction, view: WorkingView, config: InstanceConfig
) -> Float[np.ndarray, "k 2"]:
    """Return the peaks of the vote density in plan coordinates in metres, strongest first."""
    foreground = answer.foreground[::2, ::2]
    voting = (foreground > config.min_foreground) & (view.pixel[::2, ::2] > 0)
    if not voting.any():
        return np.zeros((0, 2))
    vote, spread = answer.vote[voting], answer.spread[voting]
    certainty = config.vote_std**2 / (config.vote_std**2 + spread**2)
    weight = foreground[voting] * (2 * view.pixel[::2, ::2][voting]) ** 2 * certainty
    close = (np.abs(vote - np.median(vote, axis=0)) < 2.0).all(1)  # outliers must not enlarge the grid
    vote, weight = vote[close], weight[close]
    low = vote.min(0) - 0.05
    cells = np.floor((vote - low) / config.cell).astype(np.int64)
    rows, columns = cells.max(0) + 11
    grid = np.bincount(cells[:, 0] * columns + cells[:, 1], weights=weight, minlength=rows * columns)
    sigma = config.vote_std / config.cell
    smooth = cv2.GaussianBlur(grid.reshape(rows, columns).astype(np.float32), (0, 0), sigma)
    smooth *= 2 * np.pi * sigma**2  # weight under the kernel, approximately
    reach = round(config.min_peak_distance / config.cell)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    peak = (smooth >= cv2.dilate(smooth, disc)) & (smooth > config.min_votes)
    at = np.argwhere(peak)
    order = np.argsort(-smooth[tuple(at.T)], kind="stable")
    return (at[order] + 0.5) * config.cell + low


def assign_pixels(
    answer: ScenePrediction, view: WorkingView, peaks: Float[np.ndarray, "k 2"], config: InstanceConfig
) -> Int[np.ndarray, "h w"]:
    """Return the index of the peak that each pixel of the working view is assigned to.

    Foreground pixels whose vote is far from every peak get -1; background pixels get the index of the nearest
    foreground pixel.
    """
    h, w = view.height.shape
    offset = (answer.vote - view.plan[::2, ::2]) / view.pixel[::2, ::2, None]  # smooth over the image
    fine = np.asarray(cv2.resize(offset.astype(np.float32), (2 * offset.shape[1], 2 * offset.shape[0])))[
        :h, :w
    ]
    shown = answer.foreground > config.min_foreground
    vote = view.plan[shown] + fine[shown] * view.pixel[shown][:, None]
    numbers, distance = np.zeros((h, w), np.int32), np.zeros((h, w), np.float32)
    apart = cdist(vote, peaks)
    numbers[shown], distance[shown] = apart.argmin(1), apart.min(1)
    outliers = shown & (distance > config.max_vote_distance)
    cleaned = _reassign_pieces(numbers, shown & ~outliers, distance, len(peaks), config.max_piece_distance)
    return np.where(outliers, _BACKGROUND, cleaned)


def _reassign_pieces(
    numbers: Int[np.ndarray, "h w"],
    foreground: Bool[np.ndarray, "h w"],
    distance: Float[np.ndarray, "h w"],
    count: int,
    max_piece_distance: float,
    share: float = 0.2,
) -> Int[np.ndarray, "h w"]:
    """Assign small separate components of instances, and the background, to the nearest instance.

    A component without contact to another instance keeps its own if the median ``distance`` of its votes from
    the footprint is at most ``max_piece_distance`` (in metres); otherwise it becomes background.
    """
    small, distant = np.zeros(numbers.shape, bool), np.zeros(numbers.shape, bool)
    for k in range(count):
        own = (foreground & (numbers == k)).astype(np.uint8)
        n, pieces, stats, _ = cv2.connectedComponentsWithStats(own, connectivity=8)
        if n <= 2:
            continue
        area = np.asarray(stats)[:, cv2.CC_STAT_AREA].copy()
        area[0] = 0
        small |= ((area < share * area.max()) & (area > 0))[np.asarray(pieces)]
        for piece in range(1, n):
            here = np.asarray(pieces) == piece
            if np.median(distance[here]) > max_piece_distance:
                distant |= here
    kept_pixels = foreground & ~small & ~distant
    if not kept_pixels.any():
        return numbers
    nearest, nearest_distance = fill_from_nearest(numbers, kept_pixels)
    kept = np.where(small & (nearest_distance >= 3), numbers, nearest)
    return np.where(distant & ~(small & (nearest_distance < 3)), _BACKGROUND, kept)


def _classes(
    answer: ScenePrediction, numbers: Int[np.ndarray, "h w"], count: int
) -> Float[np.ndarray, "k 5"]:
    """Return the mean class log-probabilities over each instance's pixels."""
    coarse, sure = numbers[::2, ::2], answer.foreground[::2, ::2]
    weight = np.where(coarse >= 0, np.where(sure > 0.5, sure, 1e-6), 0.0)
    flat = np.maximum(coarse, 0).ravel()
    total = np.bincount(flat, weights=weight.ravel(), minlength=count)
    sums = [
        np.bincount(flat, weights=(weight * answer.log_classes[..., c]).ravel(), minlength=count)
        for c in range(CLASSES)
    ]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-12)[:, None]


def upsample_labels(
    foreground: Float[np.ndarray, "h w"],
    numbers: Int[np.ndarray, "h w"],
    shape: tuple[int, int],
    config: InstanceConfig,
) -> Int[np.ndarray, "H W"]:
    """Return the instance index of each pixel of the frame, -1 for background."""
    if foreground.shape == tuple(shape):
        fine, owner = foreground, numbers
    else:
        size = (shape[1], shape[0])
        fine = cv2.resize(np.ascontiguousarray(foreground, np.float32), size, interpolation=cv2.INTER_LINEAR)
        owner = cv2.resize(np.ascontiguousarray(numbers, np.int32), size, interpolation=cv2.INTER_NEAREST)
    return np.where(np.asarray(fine) > config.min_foreground, np.asarray(owner), _BACKGROUND)


def _plausible(
    numbers: Int[np.ndarray, "H W"],
    classes: Float[np.ndarray, "k 5"],
    frame: RgbdFrame,
    plane: SupportPlane,
    config: InstanceConfig,
) -> tuple[list[Instance], list[LeftOut]]:
    """Return the instances that pass the checks of size, height and distance, largest first, and the rest."""
    shown = numbers >= 0
    heights, plan = height_image(frame, plane), plan_image(frame, plane)
    owner, depth, height = numbers[shown], frame.depth[shown], heights[shown]
    measured = depth > 0

    def counted(weights: np.ndarray | None = None, only: np.ndarray | slice = slice(None)) -> np.ndarray:
        return np.bincount(owner[only], None if weights is None else weights[only], minlength=len(classes))

    pixels, seen = counted(), counted(only=measured)
    distance = counted(depth, measured) / np.maximum(seen, 1)
    area = pixels * distance**2 / (frame.intrinsics.fx * frame.intrinsics.fy)
    too_high = counted(only=measured & (height > config.max_height)) > 0.02 * seen
    kept, left_out = [], []
    for k in sorted((int(k) for k in np.flatnonzero(pixels)), key=lambda k: -pixels[k]):
        mask = remove_specks(numbers == k, config.min_piece_share)
        if seen[k] == 0:
            left_out.append(LeftOut(mask, "no depth"))
        elif pixels[k] < config.min_pixels or area[k] < config.min_area:
            left_out.append(LeftOut(mask, "too small", f"{pixels[k]} px, {1e4 * area[k]:.1f} cm²"))
        elif too_high[k]:
            left_out.append(LeftOut(mask, "too high", f"above {config.max_height:g} m"))
        elif distance[k] < config.min_distance:
            left_out.append(LeftOut(mask, "too near", f"{distance[k]:.2f} m"))
        else:
            mask = without_table(mask, frame.depth > 0, heights, plan)
            kept.append(Instance(remove_specks(mask, config.min_piece_share), classes[k]))
    return kept, left_out


def remove_specks(mask: Bool[np.ndarray, "H W"], share: float) -> Bool[np.ndarray, "H W"]:
    """Return the mask without components smaller than ``share`` of its largest."""
    window = bounding_window(mask)
    inside = np.ascontiguousarray(mask[window]).view(np.uint8)
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=8)
    area = np.asarray(stats)[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    result = np.zeros_like(mask)
    result[window] = (area >= max(1.0, share * area.max()))[np.asarray(pieces, dtype=np.int32)]
    return result
