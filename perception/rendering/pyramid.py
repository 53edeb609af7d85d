"""Gaussian pyramid over rendered pixels, as one sparse matrix for each level.

The paper blurs the rendered image (1 pixel standard deviation) and halves it, several times over, for
coarse to fine optimisation: a coarse pixel then stands for many rays. Blurring is linear, so the same
matrix serves the measured depth, the rendered depth and every column of the Jacobian. Pixels without a
measurement take no part: weights are normalised over those that have one.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy import sparse

_TAPS = np.exp(-0.5 * np.arange(-2, 3) ** 2)
_TAPS = _TAPS / _TAPS.sum()
_MIN_SUPPORT = 0.4  # share of its Gaussian that a coarse pixel must have measured


def pyramid_operator(valid: Bool[np.ndarray, "h w"], level: int) -> sparse.csr_matrix:
    """The matrix from the valid pixels, row by row, to those of a coarser level.

    Args:
        valid: which pixels take part; their values are ordered as ``image[valid]``.
        level: how often to blur and halve; 0 is the identity.
    """
    operator = sparse.csr_matrix(sparse.eye_array(int(valid.sum())), dtype=np.float32)
    for _ in range(level):
        down, valid = _blur_and_halve(valid)
        operator = down @ operator
    return sparse.csr_matrix(operator)


def _blur_and_halve(valid: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
    """One level: 5 x 5 Gaussian at every other pixel. Returns the matrix and the valid coarse pixels."""
    height, width = valid.shape
    index = np.full((height, width), -1)
    index[valid] = np.arange(int(valid.sum()))
    v, u = np.meshgrid(np.arange(0, height, 2), np.arange(0, width, 2), indexing="ij")
    rows, columns, weights = [], [], []
    coarse = np.arange(v.size).reshape(v.shape)
    for dv, wv in zip(range(-2, 3), _TAPS):
        for du, wu in zip(range(-2, 3), _TAPS):
            vv, uu = v + dv, u + du
            inside = (vv >= 0) & (vv < height) & (uu >= 0) & (uu < width)
            source = index[np.clip(vv, 0, height - 1), np.clip(uu, 0, width - 1)]
            take = inside & (source >= 0)
            rows.append(coarse[take])
            columns.append(source[take])
            weights.append(np.full(int(take.sum()), wv * wu))
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    matrix = sparse.csr_matrix(entries, shape=(v.size, int(valid.sum())), dtype=np.float32)
    support = np.asarray(matrix.sum(axis=1)).ravel()
    keep = support > _MIN_SUPPORT
    matrix = sparse.diags(1 / support[keep], dtype=np.float32) @ matrix[keep]
    return sparse.csr_matrix(matrix), keep.reshape(v.shape)
