"""Forward warping and occlusion: widths of shadows by hand."""

import numpy as np
import pytest

from sim_assets.rendering.depth_sensors.parallax import UNSEEN, hidden_from, source_columns


def box_before_wall(near=20.0, far=8.0, rows=3):
    disparity = np.full((rows, 100), far, dtype=np.float32)
    disparity[:, 40:60] = near
    return disparity


@pytest.mark.parametrize(("near", "far"), [(20, 8), (15, 12), (30, 5)])
def test_the_shadow_lies_left_of_a_near_surface_and_is_the_difference_of_disparities_wide(near, far):
    hidden = hidden_from(box_before_wall(near, far))
    width = near - far
    # A box of 20 columns hides no more than 20 columns of the wall, starting at its own shadow's edge.
    expected = np.zeros(100, dtype=bool)
    expected[40 - width : min(40, 60 - width)] = True
    assert np.array_equal(hidden[1], expected)


def test_an_eye_to_the_left_mirrors_the_shadow():
    disparity = box_before_wall()
    mirrored = hidden_from(-disparity[:, ::-1])
    assert np.array_equal(mirrored, hidden_from(disparity)[:, ::-1])


def test_a_slope_hides_nothing_of_itself():
    disparity = np.tile(np.linspace(5, 25, 100, dtype=np.float32), (2, 1))
    assert not hidden_from(disparity).any() and not hidden_from(disparity[:, ::-1].copy()).any()


def test_the_right_eye_shows_the_nearer_surface_and_gaps_where_only_it_sees():
    source = source_columns(box_before_wall(), 20)[1]
    columns = np.arange(120) - 20
    box = (columns >= 20) & (columns < 40)
    np.testing.assert_allclose(source[box], columns[box] + 20)
    gap = (columns >= 40) & (columns < 52)
    assert np.all(source[gap] == UNSEEN)
    np.testing.assert_allclose(source[columns == 60], 68)
    np.testing.assert_allclose(source[columns == -5], 3)


def test_sources_on_a_slope_are_exact_between_pixels():
    disparity = np.tile(
        10 + 0.3 * np.arange(80, dtype=np.float32), (1, 1)
    )  # s - d(s) = x: s = (x + 10) / 0.7
    source = source_columns(disparity, 12)[0]
    columns = np.arange(-5, 40)
    np.testing.assert_allclose(source[columns + 12], (columns + 10) / 0.7, atol=1e-3)
