from dataclasses import replace

import numpy as np

from manipulation.footprints import BoxRaster, Stencil, footprint
from manipulation.grasps import grasp_candidates
from manipulation.release_clearance import ReleasePose, count_free_releases
from manipulation.robot import GripperGeometry
from manipulation.standing import to_standing
from manipulation.types import Box


def items_of(shapes, *kinds):
    """Standing objects from (category, mesh) pairs."""
    return [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]


def test_a_tall_neighbour_takes_the_hands_room(shapes):
    mug, tall = items_of(shapes, ("mug", shapes.mug()), ("bottle", shapes.bottle(radius=0.04, height=0.26)))
    grasps = grasp_candidates(mug).grasps
    raster = BoxRaster(Box(), 0.008)
    free = count_free_releases(raster, grasps, ReleasePose(np.zeros(2), 0.0, 0.004))
    assert free == len(grasps)
    stencil = Stencil.of(footprint(tall), 0.0, raster.cell)
    raster.add(stencil, (len(raster.x) // 2, len(raster.y) // 2 + 18))
    assert 0 < count_free_releases(raster, grasps, ReleasePose(np.zeros(2), 0.0, 0.004)) < free
    assert count_free_releases(raster, [], ReleasePose(np.zeros(2), 0.0, 0.0)) == 0
    broad = GripperGeometry(palm_half_width=0.08)
    assert count_free_releases(raster, grasps, ReleasePose(np.zeros(2), 0.0, 0.004), broad) == 0


def test_a_tilted_hand_reaches_lower_on_one_side(shapes):
    """Over the rim of a low bowl whose wall leans by 30 degrees, the palm comes down to the wall outside."""
    (bowl,) = items_of(shapes, ("bowl", shapes.bowl(radius=0.065, height=0.04, slope=np.deg2rad(30))))
    grasps = grasp_candidates(bowl).grasps
    box = replace(Box(), size=(0.5, 0.5, 0.08))
    raster = BoxRaster(box, 0.008)
    assert count_free_releases(raster, grasps, ReleasePose(np.zeros(2), 0.0, 0.004)) == len(grasps)
    in_the_corner = np.array(box.size[:2]) / 2 - 0.065 - 0.01
    assert 0 < count_free_releases(raster, grasps, ReleasePose(in_the_corner, 0.0, 0.004)) < 0.6 * len(grasps)
    outwards = [grasp for grasp in grasps if np.cos(grasp.azimuth - np.pi / 4) > 0.8]
    assert count_free_releases(raster, outwards, ReleasePose(in_the_corner, 0.0, 0.004)) == 0
