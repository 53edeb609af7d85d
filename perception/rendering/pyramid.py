"""Gaussian pyramid over rendered pixels (NodeSLAM, section "Probabilistic Rendering"), as sparse matrices.

Each level blurs with a standard deviation of 1 pixel and halves the resolution, for coarse-to-fine
optimisation: a coarse pixel averages many rays. Blurring is linear, so one matrix applies to the measured
and the rendered depth and every column of the Jacobian. Weights are normalised over the valid pixels.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy import sparse

_TAPS = np.exp(-0.5 * np.arange(-2, 3) ** 2)  # Gaussian of 1 pixel standard deviation
_TAPS = _TAPS / _TAPS.sum()
_MIN_SUPPORT = 0.4  # minimum share of a coarse pixel's Gaussian on valid pixels


def pyramid_operator(valid: Bool[np.ndarray, "h w"], level: int) -> sparse.csr_matrix:
    """Return the matrix from the valid pixels to the supported pixels of a coarser level, both row-major.

    Args:
        valid: Pixels with a valid measurement; columns are ordered as ``image[valid]``.
        level: Number of reductions; 0 gives the identity.
    """
    operator = sparse.csr_matrix(sparse.eye_array(int(valid.sum())), dtype=np.float32)
    for _ in range(level):
        down, valid = _blur_and_halve(valid)
        operator = down @ operator
    return sparse.csr_matrix(operator)


def _blur_and_halve(valid: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Return the matrix of one level, a 5 x 5 Gaussian at every other pixel, and its valid coarse pixels."""
    blur_rows, blur_columns = (_blur_line(n) for n in valid.shape)
    matrix = sparse.kron(blur_rows, blur_columns, format="csc")[:, np.flatnonzero(valid)].tocsr()
    support = np.asarray(matrix.sum(axis=1)).ravel()
    keep = support > _MIN_SUPPORT
    matrix = sparse.diags(1 / support[keep], dtype=np.float32) @ matrix[keep]
    return sparse.csr_matrix(matrix), keep.reshape(len(blur_rows), len(blur_columns))


def _blur_line(length: int) -> np.ndarray:
    """Return the (ceil(length / 2), length) 1D blur at every other pixel, truncated at both ends."""
    distance = np.abs(np.arange(length) - np.arange(0, length, 2)[:, None])
    return np.where(distance <= 2, _TAPS[2 + np.minimum(distance, 2)], 0.0).astype(np.float32)
