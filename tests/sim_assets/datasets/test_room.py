"""Rooms: the table carries the items, the things around it stand on the floor beside it."""

import numpy as np
import pytest
from trimesh import creation

from sim_assets.datasets.room import BELOW, HIDDEN, SHOWN, Room, add_room
from sim_assets.datasets.scene_config import GRIPPABLE_TABLE, RoomConfig
from sim_assets.rendering.headless import mujoco

CONFIG = RoomConfig(pool=3, things=(1, 3))
SPREAD = 0.3


@pytest.fixture(scope="module")
def surroundings():
    return [creation.box((0.4, 0.3, 1.0)).apply_translation((0, 0, 0.5)) for _ in range(3)]


@pytest.fixture
def model(surroundings):
    spec = mujoco.MjSpec()
    add_room(spec, surroundings, np.random.default_rng(0))
    return spec.compile()


def shown(model, name):
    return model.geom_group[model.geom(name).id] != HIDDEN


def test_without_configuration_the_table_is_large_and_nothing_is_around(model, surroundings):
    Room(model, None, surroundings).vary(np.random.default_rng(0), SPREAD, 0.0)
    table = model.geom("table")
    np.testing.assert_allclose(table.size[:2], GRIPPABLE_TABLE)
    assert table.pos[2] == -table.size[2] and not shown(model, "round")
    assert all(model.body(f"around{i}").pos[2] == BELOW for i in range(3))


def test_the_support_surface_is_at_zero_and_carries_all_items(model, surroundings):
    room, kinds = Room(model, CONFIG, surroundings), set()
    corners = SPREAD * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    for seed in range(60):
        room.vary(np.random.default_rng(seed), SPREAD, 0.3)
        table, cylinder, floor = (model.geom(name) for name in ("table", "round", "floor"))
        kinds.add((shown(model, "table"), shown(model, "round")))
        if shown(model, "table"):
            assert table.pos[2] + table.size[2] == pytest.approx(0) and floor.pos[2] < -0.3
            yaw = 2 * np.arctan2(table.quat[3], table.quat[0])
            c, s = np.cos(yaw), np.sin(yaw)
            local = (corners - table.pos[:2]) @ np.array([[c, -s], [s, c]])
            assert (np.abs(local) < table.size[:2]).all()
        elif shown(model, "round"):
            assert cylinder.pos[2] + cylinder.size[1] == pytest.approx(0)
            assert (np.linalg.norm(corners - cylinder.pos[:2], axis=1) < cylinder.size[0]).all()
        else:
            assert floor.pos[2] == 0
    assert kinds == {(True, False), (False, True), (False, False)}


def test_things_around_stand_on_the_floor_clear_of_the_table(model, surroundings):
    room, counts = Room(model, CONFIG, surroundings), set()
    for seed in range(40):
        room.vary(np.random.default_rng(seed), SPREAD, 2.0)
        floor = model.geom("floor").pos[2]
        visible = [i for i in range(3) if model.geom_group[model.geom(f"around{i}").id] == SHOWN]
        counts.add(len(visible))
        for i in range(3):
            at = model.body(f"around{i}").pos
            assert at[2] == (floor if i in visible else BELOW)
            if i in visible and shown(model, "table"):
                table = model.geom("table")
                assert np.linalg.norm(at[:2] - table.pos[:2]) > np.linalg.norm(table.size[:2]) + 0.2
    assert counts == {1, 2, 3}


def test_walls_leave_the_camera_its_side(model, surroundings):
    """A camera up to 1.5 m away at the given azimuth is on the table's side of both walls."""
    room = Room(model, CONFIG, surroundings)
    for seed in range(40):
        azimuth = np.random.default_rng(100 + seed).uniform(-np.pi, np.pi)
        room.vary(np.random.default_rng(seed), SPREAD, azimuth)
        camera = 1.5 * np.array([np.cos(azimuth), np.sin(azimuth)])
        for name in ("wall", "far wall"):
            if shown(model, name):
                at = model.geom(name).pos[:2]
                assert camera @ at / np.linalg.norm(at) < np.linalg.norm(at) - 0.02
