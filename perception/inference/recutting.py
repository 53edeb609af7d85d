"""Instances of no class that are cut in pieces, or joined, where a fit confirms it.

The instance network knows upright objects best. It may join a lying one with what it touches, which leaves
creases between them (``touching``), in some views only (``agreement``), or cut it where its colour changes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import cv2
import numpy as np

from perception.depth_cleaning import clean_frame
from perception.detection.completion import PoseNamer, posed_detections
from perception.detection.poses import pose_mass
from perception.inference.agreement import agreed_masks
from perception.inference.color_cuts import color_pieces
from perception.inference.explanation import unexplained
from perception.inference.observation import ObjectObservation
from perception.inference.reconstruct import mean_probabilities
from perception.inference.stack_parts import Rows, instance_points
from perception.inference.touching import MIN_PIXELS, touching_pieces
from perception.threads import worker_pool
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane, unclassified

LYING = 0.3  # least probability of lying of each instance that is joined
MOST = 6  # pairs that are tried
EXPLAINED = 0.12  # largest share of their points that the joint shape leaves unexplained
CLEAR = 0.75  # least score of what is joined
WORSE = 0.05  # by how much it may be lower than that of a part beside which the other one is no object
GAP = 5  # [px] between the masks of one object


@dataclass(frozen=True)
class Recutting:
    """Cuts and joins instances of one scene.

    Attributes:
        frames: Views with camera poses.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        completer: Names pieces and pairs.
        fit: Reconstructs instances; detections without an id only occlude others.
        workers: Number of pairs that are fitted at a time; None for the number of cores.
    """

    frames: Sequence[RgbdFrame]
    planes: Sequence[SupportPlane]
    completer: PoseNamer
    fit: Callable[[Rows], Sequence[ObjectEstimate]]
    workers: int | None = None

    def separated(
        self, rows: Rows, ids: Collection[int], first_id: int
    ) -> tuple[Rows, dict[int, ObjectEstimate]]:
        """Return the detections with instances cut in their pieces, and the estimates of the pieces by id.

        Args:
            rows: Associated detections of each frame.
            ids: Instances of no class that no shape explains.
            first_id: Least id of a piece.
        """
        if not ids:
            return rows, {}
        views = [clean_frame(frame) for frame in self.frames]
        cut = touching_pieces(views, rows, ids, self.planes[0], first_id)
        pieces = [[d for d in row if _number(d) >= first_id] for row in cut]
        if not any(pieces):
            return rows, {}
        named = posed_detections(self.frames, pieces, self.planes, self.completer)
        recut = _recut(cut, instance_ids(pieces), named)
        return recut, {e.id: e for e in self.fit(_only(recut, instance_ids(named)))}

    def parted(
        self,
        rows: Rows,
        ids: Collection[int],
        first_id: int,
        is_kept: Callable[[ObjectEstimate, Rows], bool],
    ) -> tuple[Rows, dict[int, ObjectEstimate]]:
        """Return the detections with instances cut between two colours, and the estimates of pieces, by id.

        Where the fit to a piece that may lie is kept: beside what an object touches there need not be a
        crease. Whether it may lie shows when it has been cut off from what is upright beside it.

        Args:
            rows: Associated detections of each frame.
            ids: Instances of no class that no shape explains.
            first_id: Least id of a piece.
            is_kept: Whether the estimate of a piece, given the detections with it, is good enough.
        """
        pieces: dict[int, int] = {}  # ids of the instances, by those of their pieces
        cut: list[list[ObjectDetection]] = [[] for _ in rows]
        for id in sorted(ids):
            own = {k: d for k, row in enumerate(rows) for d in row if d.instance_id == id}
            found = color_pieces({k: ObjectObservation(self.frames[k], d.mask) for k, d in own.items()})
            if found is None:
                continue
            for number in (0, 1):
                piece = first_id + len(pieces)
                pieces[piece] = id
                for k, masks in found.items():
                    if masks[number].sum() >= MIN_PIXELS:
                        cut[k].append(replace(unclassified(masks[number], piece), support=own[k].support))
        if not pieces:
            return rows, {}
        named = posed_detections(self.frames, cut, self.planes, self.completer)
        lying = {piece for piece in pieces if _may_lie(named, piece)}
        if not lying:
            return rows, {}
        recut = _recut(rows, set(pieces.values()), named)
        kept = {e.id: e for e in self.fit(_only(recut, lying)) if is_kept(e, recut)}
        gone = {pieces[piece] for piece in kept}
        halves = {piece for piece, id in pieces.items() if id in gone}
        return _recut(rows, gone, [[d for d in row if d.instance_id in halves] for row in named]), kept

    def agreed(
        self, rows: Rows, ids: Collection[int], is_kept: Callable[[ObjectEstimate], bool]
    ) -> tuple[Rows, dict[int, ObjectEstimate]]:
        """Return the detections with the masks of instances trimmed, and the estimates from these, by id.

        Of each mask that is left on which the views agree (``agreement``), where the fit to that is kept.

        Args:
            rows: Associated detections of each frame.
            ids: Instances of no class that no shape explains.
            is_kept: Whether an estimate is good enough.
        """
        own = agreed_masks([clean_frame(frame) for frame in self.frames], rows, ids) if ids else []
        if not any(own):
            return rows, {}
        named = posed_detections(self.frames, own, self.planes, self.completer)
        recut = _recut(rows, instance_ids(own), named)
        kept = {e.id: e for e in self.fit(_only(recut, instance_ids(named))) if is_kept(e)}
        return _recut(rows, set(kept), [[d for d in row if d.instance_id in kept] for row in named]), kept

    def joined(
        self, rows: Rows, ids: Collection[int], estimates: Mapping[int, ObjectEstimate], first_id: int
    ) -> tuple[Rows, dict[int, ObjectEstimate]]:
        """Return the detections with pairs that are one lying object as one, and its estimate by id.

        What was joined is tried with what it touches in turn: bottles have caps and labels of other colours.
        Its score is at least ``CLEAR``, and that of either part, or a little less if one is none alone.

        Args:
            rows: Associated detections of each frame.
            ids: Instances of no class.
            estimates: Estimates of instances by id; rejected ones are missing.
            first_id: Least id of what is joined.
        """
        found: dict[int, ObjectEstimate] = {}
        latest: set[int] | None = None  # what the last pass has joined
        while latest is None or latest:
            left = sorted((set(ids) | set(found)) & instance_ids(rows))
            pairs = touching_pairs(rows, [id for id in left if _may_lie(rows, id)])
            if latest is not None:
                pairs = [pair for pair in pairs if latest & set(pair)]
            free = max([first_id - 1, *found]) + 1
            rows, joint = self._join(rows, pairs[:MOST], {**estimates, **found}, free)
            found |= joint
            latest = set(joint)
        return rows, {id: estimate for id, estimate in found.items() if id in instance_ids(rows)}

    def _join(
        self,
        rows: Rows,
        pairs: Sequence[tuple[int, int]],
        estimates: Mapping[int, ObjectEstimate],
        first_id: int,
    ) -> tuple[Rows, dict[int, ObjectEstimate]]:
        """Return the detections with the pairs that are one lying object as one, and its estimate by id."""
        numbers = range(first_id, first_id + len(pairs))
        with worker_pool(self.workers) as pool:
            tried = list(pool.map(partial(self._joined_pair, rows), pairs, numbers))
        found: dict[int, ObjectEstimate] = {}
        for number, pair, one in zip(numbers, pairs, tried):
            if not instance_ids(rows) >= set(pair):
                continue  # one of them belongs to another object
            paired, estimate = self._joined_pair(rows, pair, number) if found else one  # others were joined
            if estimate is None:
                continue
            alone = [estimates[id].score for id in pair if id in estimates]
            worse = WORSE if len(alone) == 1 else 0.0
            if estimate.score >= max([CLEAR, *(score - worse for score in alone)]):
                rows, found[number] = paired, estimate
        return rows, found

    def _joined_pair(
        self, rows: Rows, pair: tuple[int, int], number: int
    ) -> tuple[Rows, ObjectEstimate | None]:
        """Return the detections with two instances as one, and its estimate if it explains enough of both."""
        points = np.concatenate([instance_points(self.frames, rows, id) for id in pair])
        own = [[whole] if (whole := _union(row, pair, number)) else [] for row in rows]
        named = posed_detections(self.frames, own, self.planes, self.completer)
        paired = _recut(rows, pair, named)
        estimate = next(iter(self.fit(_only(paired, {number}))), None)
        if estimate is None or unexplained(points, [estimate]) > EXPLAINED:
            return paired, None
        return paired, estimate


def instance_ids(rows: Rows) -> set[int]:
    """Return the ids of all instances."""
    return {d.instance_id for row in rows for d in row if d.instance_id is not None}


def touching_pairs(rows: Rows, ids: Collection[int]) -> list[tuple[int, int]]:
    """Return the pairs of instances whose masks touch in at least half of the views that show both.

    Those that touch in most views come first.
    """
    kernel = np.ones((GAP, GAP), np.uint8)
    touches: dict[tuple[int, int], list[bool]] = {}
    for row in rows:
        masks = {d.instance_id: d.mask for d in row if d.instance_id in ids}
        wide = {id: cv2.dilate(mask.astype(np.uint8), kernel) > 0 for id, mask in masks.items()}
        for one, other in combinations(sorted(id for id in masks if id is not None), 2):
            touches.setdefault((one, other), []).append(bool((wide[one] & masks[other]).any()))
    near = [pair for pair, seen in touches.items() if 2 * sum(seen) >= len(seen) and any(seen)]
    return sorted(near, key=lambda pair: (-sum(touches[pair]), pair))


def _recut(rows: Rows, gone: Collection[int], pieces: Rows) -> list[list[ObjectDetection]]:
    """Return the detections without those of some instances, and with others."""
    return [
        [*(d for d in row if d.instance_id not in gone), *new] for row, new in zip(rows, pieces, strict=True)
    ]


def _only(rows: Rows, ids: Collection[int]) -> Rows:
    """Return the detections, of which those of other instances have no id."""
    return [[d if d.instance_id in ids else replace(d, instance_id=None) for d in row] for row in rows]


def _number(detection: ObjectDetection) -> int:
    return -1 if detection.instance_id is None else detection.instance_id


def _may_lie(rows: Rows, id: int) -> bool:
    views = [d.pose_probabilities for row in rows for d in row if d.instance_id == id]
    return pose_mass(mean_probabilities([p for p in views if p.size]), "lying") >= LYING


def _union(row: Sequence[ObjectDetection], pair: tuple[int, int], number: int) -> ObjectDetection | None:
    """Return the detection of no class of two instances in one view; None if it shows neither."""
    own = [d for d in row if d.instance_id in pair]
    if not own:
        return None
    return replace(unclassified(np.any([d.mask for d in own], axis=0), number), support=own[0].support)
