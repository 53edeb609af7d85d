"""How alike two parts of what was segmented as one are in colour: as teapot and lid, or as few stacks are.

The colours of a part are a histogram over CIE Lab, coarse in lightness, which shading changes, and smoothed,
so that a colour at the edge of a cell is not another one. The overlap of two is that of their shares:

    o = sum_k min(p_k, q_k).

Of the pairs in 25 scans of generated tables that would be accepted otherwise, it is 0.80 for the two that are
teapots, and 0.54 at most for the other 48.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import convolve1d

from perception.types import RgbdFrame

ALIKE = 0.6  # overlap from which on two parts are alike
_LIGHTNESS, _CHROMA = 20.0, 12.0  # widths of the cells, in units of CIE Lab
_CELLS = (
    np.arange(-_LIGHTNESS, 100 + 2 * _LIGHTNESS, _LIGHTNESS),
    np.arange(-9 * _CHROMA, 9.5 * _CHROMA, _CHROMA),
    np.arange(-9 * _CHROMA, 9.5 * _CHROMA, _CHROMA),
)


def color_overlap(
    first: Iterable[tuple[RgbdFrame, Bool[np.ndarray, "h w"]]],
    second: Iterable[tuple[RgbdFrame, Bool[np.ndarray, "h w"]]],
) -> float:
    """Return the overlap of the colours of two parts, from 0 to 1.

    Args:
        first, second: Images with the pixels of the part that they show.
    """
    return float(np.minimum(_shares(first), _shares(second)).sum())


def _shares(shown: Iterable[tuple[RgbdFrame, Bool[np.ndarray, "h w"]]]) -> Float[np.ndarray, "l a b"]:
    """Return the share of the pixels in each cell of the colour space; zeros without pixels."""
    rgb = np.concatenate([np.zeros((0, 3), np.uint8), *(frame.rgb[mask] for frame, mask in shown)])
    lab = cv2.cvtColor(rgb[None].astype(np.float32) / 255, cv2.COLOR_RGB2Lab)[0] if len(rgb) else rgb
    cells = np.histogramdd(lab, bins=_CELLS)[0]
    for axis in range(3):
        cells = convolve1d(cells, [0.25, 0.5, 0.25], axis=axis, mode="constant")
    return cells / max(cells.sum(), 1e-9)
