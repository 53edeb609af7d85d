import numpy as np
import pytest

import manipulation.cross_sections as module
from manipulation.cross_sections import CrossSectionCache, Extent, extent, fit_circle

SQUARE = np.array(  # from (-1, -2) to (3, 2)
    [[[-1.0, -2], [3, -2]], [[3, -2], [3, 2]], [[3, 2], [-1, 2]], [[-1, 2], [-1, -2]]]
)


def test_extent_along_the_axes_and_the_diagonal():
    assert extent(SQUARE, 0.0) == Extent(-1.0, 3.0)
    along_y = extent(SQUARE, np.pi / 2)
    assert along_y is not None and (along_y.low, along_y.high) == pytest.approx((-2.0, 2.0))
    diagonal = extent(SQUARE, np.pi / 4)
    assert diagonal is not None and diagonal.high == pytest.approx(5.0 / np.sqrt(2))
    assert extent(np.zeros((0, 2, 2)), 0.0) is None


def test_width_and_middle_of_an_extent():
    assert Extent(-1.0, 4.0).width == 5.0 and Extent(-1.0, 4.0).middle == 1.5


def test_sections_are_cached_by_tenths_of_a_millimetre(shapes, monkeypatch):
    mesh, heights = shapes.cup(radius=0.04, wall=0.004), []
    compute = module.cross_section
    monkeypatch.setattr(module, "cross_section", lambda v, f, z: (heights.append(z), compute(v, f, z))[1])
    cache = CrossSectionCache(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    first = cache.at(0.05)
    assert cache.at(0.05004) is first and heights == [pytest.approx(0.05, abs=1e-5)]
    assert cache.at(0.0502) is not first and heights[1] == pytest.approx(0.0502, abs=1e-5)
    assert extent(first, 0.0).width == pytest.approx(0.08, abs=2e-4)


def test_circle_fit_is_exact_on_a_circle():
    angle = np.linspace(0, 2, 9)
    center, radius = fit_circle(np.stack([0.3 + 2 * np.cos(angle), -0.1 + 2 * np.sin(angle)], axis=1))
    assert center == pytest.approx([0.3, -0.1]) and radius == pytest.approx(2)
