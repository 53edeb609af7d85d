"""Points on collision geoms, in the frame of the hand, and which of them move."""

import numpy as np
import pytest

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.finger_motion import sweep_hand
from sim_assets.robots.hand_surface import geom_points, hand_surface
from tests.sim_assets.robots.conftest import JOINTS


def test_points_of_the_fingers_move_and_those_of_the_palm_do_not(sliding_model):
    sweep = sweep_hand(sliding_model, JOINTS, ("left", "right"))
    surface = hand_surface(sliding_model, sliding_model.body("wrist").id, sweep)
    travel = np.ptp(surface.points, axis=0)
    np.testing.assert_allclose(travel[surface.moves, 1], 0.04, atol=1e-4)
    assert travel[~surface.moves].max() < 1e-6
    palm = surface.points[0, surface.body == sliding_model.body("wrist").id]
    np.testing.assert_allclose(palm.max(axis=0), (0.02, 0.06, 0.03), atol=1e-6)


def test_a_hand_without_collision_geoms_is_refused(sliding_model):
    sweep = sweep_hand(sliding_model, JOINTS, ("left", "right"))
    bare = mujoco.MjModel.__copy__(sliding_model)
    bare.geom_contype[:] = 0
    with pytest.raises(RobotFileError, match="no collision geoms"):
        hand_surface(bare, bare.body("wrist").id, sweep)


@pytest.mark.parametrize(
    ("geom", "extent"),
    [
        ('type="box" size=".01 .02 .03"', (0.02, 0.04, 0.06)),
        ('type="sphere" size=".01"', (0.02, 0.02, 0.02)),
        ('type="cylinder" size=".01 .02"', (0.02, 0.02, 0.04)),
        ('type="capsule" size=".01 .02"', (0.02, 0.02, 0.06)),
        ('type="ellipsoid" size=".01 .02 .03"', (0.02, 0.04, 0.06)),
    ],
)
def test_points_on_geoms_span_them(geom, extent):
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><geom {geom}/></worldbody></mujoco>")
    points = geom_points(model, 0)
    np.testing.assert_allclose(np.ptp(points, axis=0), extent, rtol=0.03)
