import numpy as np
import pytest

from manipulation.arm_model import (
    COLLISION_GROUP,
    collision_spec,
    joint_addresses,
    joint_range,
    kinematic_model,
    site_index,
)
from manipulation.errors import ManipulationError


def test_collision_spec_keeps_the_collision_geoms_only(arm):
    model = collision_spec(arm.mjcf).compile()
    assert model.ngeom > 7 and (model.geom_group == COLLISION_GROUP).all()
    assert model.nu == 0 and model.njnt == 9


def test_kinematic_model_has_the_arm_joints_and_no_geoms(arm):
    model = kinematic_model(arm)
    assert model.ngeom == 0
    assert [model.joint(i).name for i in range(model.njnt)] == list(arm.joint_names)


def test_addresses_and_limits_follow_the_order_of_the_names(arm):
    model = collision_spec(arm.mjcf).compile()
    names = ("joint4", "joint1")
    np.testing.assert_array_equal(joint_addresses(model, names), [3, 0])
    np.testing.assert_allclose(joint_range(model, names), [[-3.0718, -2.8973], [-0.0698, 2.8973]])
    assert model.site(site_index(model, arm.tcp_site)).name == arm.tcp_site


def test_missing_joints_and_sites_are_named(arm):
    model = kinematic_model(arm)
    with pytest.raises(ManipulationError, match="the arm's MJCF has no joint 'joint9'"):
        joint_addresses(model, ("joint1", "joint9"))
    with pytest.raises(ManipulationError, match="the arm's MJCF has no site 'flange'"):
        site_index(model, "flange")
