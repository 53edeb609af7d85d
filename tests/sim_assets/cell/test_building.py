"""Cells at rest: objects where the layout put them, drawn again until nothing falls, or refused."""

import numpy as np
import pytest

from sim_assets.cell import building
from sim_assets.cell.building import build_settled
from sim_assets.cell.config import CellConfig
from sim_assets.cell.layout import UnstableError
from sim_assets.cell.settling import Unsettled
from sim_assets.errors import RobotFileError
from sim_assets.objects import sample_object
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.panda_arm import Q_READY


def build(seed=1, **options):
    rng = np.random.default_rng(seed)
    config = CellConfig(tuple(sample_object(c, "test", rng) for c in ("can", "can")), **options)
    layout, look = np.random.SeedSequence(seed).spawn(2)
    return build_settled(config, np.random.default_rng(layout), look)


def poses(model, data):
    return np.array([data.joint(f"object{index}").qpos for index in range(2)])


def test_objects_rest_where_they_were_put_and_the_arm_is_at_home():
    model, data = build()
    start = [model.qpos0[model.joint(f"object{index}").qposadr[0] :][:7] for index in range(2)]
    np.testing.assert_allclose(poses(model, data), start, atol=2e-3)
    assert np.abs(data.qvel).max() < 1e-2
    arm = [data.joint(f"joint{index}").qpos[0] for index in range(1, 8)]
    np.testing.assert_allclose(arm, Q_READY, atol=2e-3)


def test_the_seed_alone_decides():
    np.testing.assert_array_equal(poses(*build(seed=3)), poses(*build(seed=3)))
    assert np.abs(poses(*build(seed=3)) - poses(*build(seed=4))).max() > 0.01


def test_a_mesh_that_mujoco_cannot_read_is_an_error_of_the_arm(monkeypatch, tmp_path):
    (tmp_path / "shell.dae").write_text("COLLADA")
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><asset><mesh name="shell" file="{tmp_path}/shell.dae"/></asset>'
        '<worldbody><geom type="mesh" mesh="shell"/></worldbody></mujoco>'
    )
    monkeypatch.setattr(building, "build_scene", lambda *_: spec)
    with pytest.raises(
        RobotFileError, match=r"does not compile: no decoder .*shell\.dae.*; repair the model"
    ):
        build()


def test_a_layout_in_which_something_falls_is_replaced(monkeypatch):
    answers = iter([Unsettled("object0", "object0 fell"), None])
    monkeypatch.setattr(building, "settle_bodies", lambda *_: next(answers))
    build(drawn_together=True)
    assert next(answers, "none left") == "none left"


def test_a_layout_in_which_something_only_balances_is_the_last_resort(monkeypatch):
    stable, balancing = None, Unsettled("object0", "object0 fell")
    answers = iter([balancing, stable])
    monkeypatch.setattr(building, "fallen_after_nudge", lambda *_: next(answers))
    second = poses(*build(drawn_together=True))
    assert next(answers, "none left") == "none left"
    monkeypatch.setattr(building, "fallen_after_nudge", lambda *_: stable)
    first = poses(*build(drawn_together=True))
    assert np.abs(second - first).max() > 1e-3
    monkeypatch.setattr(building, "fallen_after_nudge", lambda *_: balancing)
    np.testing.assert_array_equal(poses(*build(drawn_together=True)), first)


def test_objects_that_never_rest_are_named(monkeypatch):
    monkeypatch.setattr(building, "LAYOUTS", 2)
    monkeypatch.setattr(building, "settle_bodies", lambda *_: Unsettled("object0", "object0 rolls on"))
    with pytest.raises(UnstableError, match="2 layouts: object0 rolls on"):
        build(drawn_together=True)
