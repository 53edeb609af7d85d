import numpy as np
import pytest

from manipulation.footprints import BoxRaster, Stencil, footprint
from manipulation.standing import to_standing
from manipulation.types import Box


def items_of(shapes, *kinds):
    """Standing objects from (category, mesh) pairs."""
    return [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]


def test_raster_keeps_walls_and_gaps(shapes):
    (item,) = items_of(shapes, ("can", shapes.can(radius=0.03)))
    raster = BoxRaster(Box(size=(0.2, 0.1, 0.08)), wall_gap=0.005)
    stencil = Stencil.of(footprint(item), 0.01, raster.cell)
    i, j = np.nonzero(raster.free_positions(stencil))
    assert np.abs(raster.x[i]).max() == pytest.approx(0.1 - 0.005 - 0.04, abs=0.006)
    assert np.abs(raster.y[j]).max() <= 0.05 - 0.005 - 0.03
    middle = (len(raster.x) // 2, len(raster.y) // 2)
    raster.add(stencil, middle, base=0.004)
    assert raster.highest(np.zeros(2)) == pytest.approx(0.124, abs=1e-3)
    assert raster.highest(np.array([0.104, 0.0])) == pytest.approx(Box().top)
    assert raster.highest(np.array([5.0, 0.0])) == 0
    i, _ = np.nonzero(raster.free_positions(stencil))
    assert np.abs(raster.x[i]).min(initial=np.inf) >= 0.03 + 0.03
