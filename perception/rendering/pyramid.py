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
    blur_rows, blur_columns = (_blur_line(n) for n in valid.shape)
    matrix = sparse.kron(blur_rows, blur_columns, format="csc")[:, np.flatnonzero(valid)].tocsr()
    support = np.asarray(matrix.sum(axis=1)).ravel()
    keep = support > _MIN_SUPPORT
    matrix = sparse.diags(1 / support[keep], dtype=np.float32) @ matrix[keep]
    return sparse.csr_matrix(matrix), keep.reshape(len(blur_rows), len(blur_columns))


def _blur_line(length: int) -> np.ndarray:
    """The Gaussian around every other of so many pixels in a line, cut off at its ends."""
    away = np.abs(np.arange(length) - np.arange(0, length, 2)[:, None])
    return np.where(away <= 2, _TAPS[2 + np.minimum(away, 2)], 0.0).astype(np.float32)
