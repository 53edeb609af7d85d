"""Matrices of the Gaussian pyramid."""

import numpy as np

from perception.rendering.pyramid import pyramid_operator


def test_level_0_is_the_identity() -> None:
    np.testing.assert_array_equal(pyramid_operator(np.ones((3, 4), bool), 0).toarray(), np.eye(12))


def test_rows_are_averages() -> None:
    valid = np.random.default_rng(0).random((16, 20)) > 0.3
    for level in (1, 2):
        operator = pyramid_operator(valid, level)
        np.testing.assert_allclose(np.asarray(operator.sum(axis=1)).ravel(), 1, rtol=1e-5)
        assert operator.shape[1] == valid.sum()


def test_one_level_by_hand() -> None:
    taps = np.exp(-0.5 * np.arange(-2, 3) ** 2)
    image = np.random.default_rng(1).random((9, 9))
    operator = pyramid_operator(np.ones((9, 9), bool), 1)
    assert operator.shape == (25, 81)
    expected = (np.outer(taps, taps) / taps.sum() ** 2 * image[2:7, 2:7]).sum()  # around pixel (4, 4)
    np.testing.assert_allclose((operator @ image.ravel()).reshape(5, 5)[2, 2], expected, rtol=1e-5)


def test_invalid_pixels_have_no_weight() -> None:
    image, valid = np.ones((8, 8)), np.ones((8, 8), bool)
    image[3, 3], valid[3, 3] = 1e6, False
    np.testing.assert_allclose(pyramid_operator(valid, 1) @ image[valid], 1, rtol=1e-5)


def test_unsupported_coarse_pixels_are_dropped() -> None:
    valid = np.zeros((16, 16), bool)
    valid[:4, :4] = True
    assert pyramid_operator(valid, 1).shape[0] < 9
