"""From the scene network's answers to instances: where votes meet there is a thing.

Votes are laid on a grid in the support plane, each spread as wide as the network expects it to err; peaks are
feet of things, and each pixel belongs to the peak nearest to its vote. Touching things have feet that lie
apart, so they part where geometry sees one lump.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist
from scipy.special import expit, log_softmax

from perception.detection.geometry import height_image, window_of
from perception.detection.scene_network import CLASSES, VOTE_UNIT, SceneNet, answers
from perception.detection.working_view import WorkingView, reduced, spread_from, working_view
from perception.types import RgbdFrame, SupportPlane

_CENTIMETRE = 0.01
_NO_THING = -1


@dataclass(frozen=True)
class InstanceConfig:
    """What counts as an instance.

    Attributes:
        foreground: probability from which on a pixel shows a thing; low: masks err outwards.
        cell: of the grid of votes in [m].
        blur: standard deviation in [m] by which votes are spread at least.
        apart: least distance in [m] between the feet of two things.
        astray: votes this far in [m] from all feet are no thing's: parts of something without a foot of its
            own must not go to whatever stands next to it.
        piece_astray: the same for half of the votes of a separate piece of a thing.
        min_votes: visible area, seen square to the ray and discounted by doubt, that makes a peak, in [m^2].
        min_area, min_pixels: smallest visible area in [m^2] and mask.
        ceiling: instances that reach higher above the plane in [m] are no table-top things (an arm).
        near: instances closer to the camera in [m] are left out (the gripper).
        speck: separate pieces of a mask smaller than this share of its largest are dropped.
    """

    foreground: float = 0.42
    cell: float = 0.005
    blur: float = 0.008
    apart: float = 0.03
    astray: float = 0.06
    piece_astray: float = 0.03
    min_votes: float = 1e-4
    min_area: float = 2.5e-4
    min_pixels: int = 60
    ceiling: float = 0.40
    near: float = 0.15
    speck: float = 0.03


@dataclass(frozen=True)
class Instance:
    """One thing in an image.

    Attributes:
        mask: (H, W).
        log_classes: (5,) mean log-probabilities of the classes over its pixels.
    """

    mask: Bool[np.ndarray, "h w"]
    log_classes: Float[np.ndarray, "5"]


@dataclass(frozen=True)
class Answers:
    """The network's answers in metres, at the resolution of the working view.

    Attributes:
        foreground: (h, w) probability that a pixel shows a thing.
        log_classes: (h2, w2, 5) log-probabilities, at half the resolution.
        vote: (h2, w2, 2) place in the plane that each pixel votes for in [m].
        spread: (h2, w2) expected error of the vote in [m].
    """

    foreground: Float[np.ndarray, "h w"]
    log_classes: Float[np.ndarray, "h2 w2 5"]
    vote: Float[np.ndarray, "h2 w2 2"]
    spread: Float[np.ndarray, "h2 w2"]


def find_instances(
    frame: RgbdFrame,
    plane: SupportPlane,
    network: SceneNet,
    config: InstanceConfig = InstanceConfig(),
) -> list[Instance]:
    """The things standing on the plane, largest first; their masks do not overlap."""
    small = reduced(frame)
    if not (small.depth > 0).any():
        return []
    view = working_view(small, plane)
    answer = interpreted(answers(network, view.channels), view)
    peaks = feet(answer, view, config)
    if not len(peaks):
        return []
    numbers = assigned(answer, view, peaks, config)
    classes = _classes(answer, numbers, len(peaks))
    numbers = np.rot90(numbers, -view.turns)
    foreground = np.rot90(answer.foreground, -view.turns)
    full = at_full_size(foreground, numbers, frame.depth.shape, config)
    return _plausible(full, classes, frame, plane, config)


def interpreted(answer: Float[np.ndarray, "h2 w2 12"], view: WorkingView) -> Answers:
    """Probabilities and places from the network's numbers."""
    h, w = view.height.shape
    quarters = expit(answer[..., :4]).reshape(*answer.shape[:2], 2, 2)
    foreground = quarters.transpose(0, 2, 1, 3).reshape(2 * answer.shape[0], 2 * answer.shape[1])[:h, :w]
    plan, pixel = view.plan[::2, ::2], view.pixel[::2, ::2]
    vote = plan + VOTE_UNIT * answer[..., 4 + CLASSES : 6 + CLASSES] * pixel[..., None]
    spread = _CENTIMETRE * np.exp(np.clip(answer[..., 6 + CLASSES], -4, 4))
    return Answers(foreground, log_softmax(answer[..., 4 : 4 + CLASSES], axis=-1), vote, spread)


def feet(answer: Answers, view: WorkingView, config: InstanceConfig) -> Float[np.ndarray, "k 2"]:
    """Peaks of the votes in the plane in [m], strongest first."""
    foreground = answer.foreground[::2, ::2]
    voting = (foreground > config.foreground) & (view.pixel[::2, ::2] > 0)
    if not voting.any():
        return np.zeros((0, 2))
    vote, spread = answer.vote[voting], answer.spread[voting]
    doubt = config.blur**2 / (config.blur**2 + spread**2)
    weight = foreground[voting] * (2 * view.pixel[::2, ::2][voting]) ** 2 * doubt
    close = (np.abs(vote - np.median(vote, axis=0)) < 2.0).all(1)  # strays must not blow up the grid
    vote, weight = vote[close], weight[close]
    low = vote.min(0) - 0.05
    cells = np.floor((vote - low) / config.cell).astype(np.int64)
    rows, columns = cells.max(0) + 11
    grid = np.bincount(cells[:, 0] * columns + cells[:, 1], weights=weight, minlength=rows * columns)
    sigma = config.blur / config.cell
    smooth = cv2.GaussianBlur(grid.reshape(rows, columns).astype(np.float32), (0, 0), sigma)
    smooth *= 2 * np.pi * sigma**2  # what lies within the blur, about
    reach = round(config.apart / config.cell)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)
    peak = (smooth >= cv2.dilate(smooth, disc)) & (smooth > config.min_votes)
    at = np.argwhere(peak)
    order = np.argsort(-smooth[tuple(at.T)], kind="stable")
    return (at[order] + 0.5) * config.cell + low


def assigned(
    answer: Answers, view: WorkingView, peaks: Float[np.ndarray, "k 2"], config: InstanceConfig
) -> Int[np.ndarray, "h w"]:
    """Number of the peak that each pixel of the working view belongs to; in the background the nearest's.

    Pixels that vote for a place far from all peaks belong to none, -1.
    """
    h, w = view.height.shape
    offset = (answer.vote - view.plan[::2, ::2]) / view.pixel[::2, ::2, None]  # smooth over the image
    fine = np.asarray(cv2.resize(offset.astype(np.float32), (2 * offset.shape[1], 2 * offset.shape[0])))[
        :h, :w
    ]
    shown = answer.foreground > config.foreground
    vote = view.plan[shown] + fine[shown] * view.pixel[shown][:, None]
    numbers, distance = np.zeros((h, w), np.int32), np.zeros((h, w), np.float32)
    apart = cdist(vote, peaks)
    numbers[shown], distance[shown] = apart.argmin(1), apart.min(1)
    astray = shown & (distance > config.astray)
    tidy = _tidied(numbers, shown & ~astray, distance, len(peaks), config.piece_astray)
    return np.where(astray, _NO_THING, tidy)


def _tidied(
    numbers: Int[np.ndarray, "h w"],
    foreground: Bool[np.ndarray, "h w"],
    distance: Float[np.ndarray, "h w"],
    count: int,
    piece_astray: float,
    share: float = 0.2,
) -> Int[np.ndarray, "h w"]:
    """Small separate pieces, and the background, given to the instance that is nearest to them.

    A piece that touches no instance stays part of its own, if its votes say so (their ``distance`` from the
    foot in [m]); else it is no thing's.
    """
    loose, stray = np.zeros(numbers.shape, bool), np.zeros(numbers.shape, bool)
    for k in range(count):
        mine = (foreground & (numbers == k)).astype(np.uint8)
        n, pieces, stats, _ = cv2.connectedComponentsWithStats(mine, connectivity=8)
        if n <= 2:
            continue
        area = np.asarray(stats)[:, cv2.CC_STAT_AREA].copy()
        area[0] = 0
        loose |= ((area < share * area.max()) & (area > 0))[np.asarray(pieces)]
        for piece in range(1, n):
            here = np.asarray(pieces) == piece
            if np.median(distance[here]) > piece_astray:
                stray |= here
    firm = foreground & ~loose & ~stray
    if not firm.any():
        return numbers
    around, away = spread_from(numbers, firm)
    kept = np.where(loose & (away >= 3), numbers, around)
    return np.where(stray & ~(loose & (away < 3)), _NO_THING, kept)


def _classes(answer: Answers, numbers: Int[np.ndarray, "h w"], count: int) -> Float[np.ndarray, "k 5"]:
    """Mean log-probabilities of each instance's pixels."""
    coarse, sure = numbers[::2, ::2], answer.foreground[::2, ::2]
    weight = np.where(coarse >= 0, np.where(sure > 0.5, sure, 1e-6), 0.0)
    flat = np.maximum(coarse, 0).ravel()
    total = np.bincount(flat, weights=weight.ravel(), minlength=count)
    sums = [
        np.bincount(flat, weights=(weight * answer.log_classes[..., c]).ravel(), minlength=count)
        for c in range(CLASSES)
    ]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-12)[:, None]


def at_full_size(
    foreground: Float[np.ndarray, "h w"],
    numbers: Int[np.ndarray, "h w"],
    shape: tuple[int, int],
    config: InstanceConfig,
) -> Int[np.ndarray, "H W"]:
    """Number of the instance that each pixel of the frame shows, -1 for none."""
    if foreground.shape == tuple(shape):
        fine, owner = foreground, numbers
    else:
        size = (shape[1], shape[0])
        fine = cv2.resize(np.ascontiguousarray(foreground, np.float32), size, interpolation=cv2.INTER_LINEAR)
        owner = cv2.resize(np.ascontiguousarray(numbers, np.int32), size, interpolation=cv2.INTER_NEAREST)
    return np.where(np.asarray(fine) > config.foreground, np.asarray(owner), _NO_THING)


def _plausible(
    numbers: Int[np.ndarray, "H W"],
    classes: Float[np.ndarray, "k 5"],
    frame: RgbdFrame,
    plane: SupportPlane,
    config: InstanceConfig,
) -> list[Instance]:
    """Instances of a table-top thing's size, largest first."""
    shown = numbers >= 0
    owner, depth, height = numbers[shown], frame.depth[shown], height_image(frame, plane)[shown]
    measured = depth > 0

    def counted(weights: np.ndarray | None = None, only: np.ndarray | slice = slice(None)) -> np.ndarray:
        return np.bincount(owner[only], None if weights is None else weights[only], minlength=len(classes))

    pixels, seen = counted(), counted(only=measured)
    distance = counted(depth, measured) / np.maximum(seen, 1)
    area = pixels * distance**2 / (frame.intrinsics.fx * frame.intrinsics.fy)
    too_high = counted(only=measured & (height > config.ceiling)) > 0.02 * seen
    keep = (pixels >= config.min_pixels) & (seen > 0) & (area >= config.min_area)
    keep &= ~too_high & (distance >= config.near)
    order = sorted((int(k) for k in np.flatnonzero(keep)), key=lambda k: -pixels[k])
    return [Instance(without_specks(numbers == k, config.speck), classes[k]) for k in order]


def without_specks(mask: Bool[np.ndarray, "H W"], share: float) -> Bool[np.ndarray, "H W"]:
    """The mask without the pieces smaller than ``share`` of its largest."""
    window = window_of(mask)
    inside = np.ascontiguousarray(mask[window]).view(np.uint8)
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=8)
    area = np.asarray(stats)[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    result = np.zeros_like(mask)
    result[window] = (area >= max(1.0, share * area.max()))[np.asarray(pieces, dtype=np.int32)]
    return result
