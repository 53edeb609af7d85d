"""Candidates that were segmented in an image but are not reported as objects, with the reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool

from perception.detection.geometry import touches_border

Reason = Literal[
    "beyond the edge of the support surface",
    "does not rise above the support surface",
    "does not touch the support surface",
    "reaches below the support surface",
    "of none of the classes",
    "part of a thing of no class",
    "too small",
    "too far",
    "too near",
    "too high",
    "no depth",
    "cut by the image border",
    "too wide for one object",
    "seen in one view only",
    "not recognised as an object",
]


@dataclass(frozen=True)
class LeftOut:
    """A candidate in one image that is not reported as an object.

    Attributes:
        mask: (H, W) bool.
        reason: Why it was left out.
        detail: The figure that decided, for instance ``p = 0.93``; may be empty.
        frame: Index of the image.
        was_judged: Whether images before showed it as it is, so that fits would not tell more of it.
    """

    mask: Bool[np.ndarray, "h w"]
    reason: Reason
    detail: str = ""
    frame: int = 0
    was_judged: bool = False

    @property
    def text(self) -> str:
        """Reason and figure in one line."""
        return f"{self.reason} ({self.detail})" if self.detail else self.reason


def of_no_class(mask: Bool[np.ndarray, "h w"], probability: float, frame: int = 0) -> LeftOut:
    """Return a candidate that is none of the classes with this probability."""
    border = ", cut by the image border" if touches_border(mask, 4) else ""
    return LeftOut(mask, "of none of the classes", f"p = {probability:.2f}{border}", frame)


def summarise(left_out: Sequence[LeftOut], n_frames: int, examples: int = 3) -> list[str]:
    """Return one line for each reason, the most frequent first: how many candidates, and their figures."""
    counts = Counter(candidate.reason for candidate in left_out)
    lines = []
    for reason, count in counts.most_common():
        figures = [c.detail for c in left_out if c.reason == reason and c.detail]
        shown = ", ".join(figures[:examples]) + (", ..." if len(figures) > examples else "")
        images = len({c.frame for c in left_out if c.reason == reason})
        where = f" in {images} of {n_frames} images" if n_frames > 1 else ""
        lines.append(f"{count} left out{where}: {reason}" + (f" ({shown})" if shown else ""))
    return lines
