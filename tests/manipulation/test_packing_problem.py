"""Order of execution and cached footprints of a packing problem."""

import numpy as np

from manipulation.footprints import BoxRaster, footprint
from manipulation.grasp_config import GraspConfig
from manipulation.nesting import stack_bowls
from manipulation.packing_problem import PackingConfig, PackingProblem, ShapeCache
from manipulation.standing import to_standing
from manipulation.types import Box


def problem_of(shapes, *kinds, box=Box(), **changes):
    """Return the problem of packing objects given as (category, mesh)."""
    items = [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]
    stacks = stack_bowls([item for item in items if item.category == "bowl"])
    cell = BoxRaster(box, 0.0).cell
    by_name = {item.name: item for item in items}
    return PackingProblem(
        by_name, stacks, {}, box, PackingConfig(**changes), GraspConfig(), ShapeCache(items, cell), cell
    )


def test_bowls_come_first_from_the_largest_then_the_others_by_height(shapes):
    problem = problem_of(
        shapes,
        ("bottle", shapes.bottle()),
        ("bowl", shapes.bowl(radius=0.06, height=0.045)),
        ("can", shapes.can(height=0.06)),
        ("bowl", shapes.bowl(radius=0.075)),
    )
    assert problem.order == ["bowl_3", "bowl_1", "can_2", "bottle_0"]


def test_footprints_and_stencils_are_computed_once_per_yaw_and_gap(shapes):
    problem = problem_of(shapes, ("mug", shapes.mug()))
    cache, mug = problem.shapes, problem.items["mug_0"]
    rotated = cache.rotated("mug_0", 0.5)
    for found, expected in zip(rotated.outlines, footprint(mug).rotated(0.5).outlines, strict=True):
        np.testing.assert_array_equal(found, expected)
    assert cache.rotated("mug_0", 0.5) is rotated and cache.rotated("mug_0", 0.6) is not rotated
    stencil = cache.stencil("mug_0", 0.5, 0.01)
    assert cache.stencil("mug_0", 0.5, 0.01) is stencil
    assert cache.stencil("mug_0", 0.5, 0.02) is not stencil
    assert cache.stencil("mug_0", 0.6, 0.01) is not stencil
