"""When the optimisation is due, and what it receives and returns; the optimiser is replaced."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam import joint_optimisation
from perception.slam.bundle_window import BundleResult
from perception.slam.config import SlamConfig
from perception.slam.joint_optimisation import JointOptimisation
from perception.slam.keyframes import Keyframe
from perception.slam.mapping import Mapper

CONFIG = SlamConfig(joint_delay=3, concurrent=False)


@pytest.fixture
def mapper(cylinders, observe, T_view):
    """A mapper with the true map and keyframe 10."""
    mapper = Mapper(cylinders.plane, cylinders.decoder, CONFIG)
    mapper.world = cylinders.map()
    key = Keyframe.of(observe(T_view, number=10), np.eye(6))
    mapper.add_keyframe(key, np.zeros((0, 3)), [])
    return mapper


@pytest.fixture
def joint(cylinders, monkeypatch):
    """An optimisation that lifts the newest keyframe by a metre."""

    def lift(window, decoder, settings):
        assert decoder is cylinders.decoder and settings is CONFIG.bundle_adjustment
        key = window.keyframes[-1]
        T = np.array(key.T_world_camera)
        T[2, 3] += 1
        return BundleResult((*window.keyframes[:-1], key.with_pose(T)), {}, {}, 1.0, 0.5, 3)

    monkeypatch.setattr(joint_optimisation, "optimise_jointly", lift)
    return JointOptimisation(cylinders.decoder, CONFIG)


def test_it_is_due_after_the_delay(joint, mapper):
    assert not joint.in_progress and not joint.is_due(10)
    joint.start(mapper, mapper.keyframes[-1], at_once=False)
    assert joint.in_progress and not joint.is_due(12) and joint.is_due(13) and joint.is_due(20)


def test_it_can_be_due_at_once(joint, mapper):
    joint.start(mapper, mapper.keyframes[-1], at_once=True)
    assert joint.is_due(10)


def test_applying_corrects_the_map_and_returns_the_correction(joint, mapper):
    before = mapper.keyframes[-1].T_world_camera
    joint.start(mapper, mapper.keyframes[-1], at_once=False)
    correction = joint.apply(mapper)
    np.testing.assert_allclose(correction @ before, mapper.keyframes[-1].T_world_camera, atol=1e-12)
    np.testing.assert_allclose(correction[:3, 3], [0, 0, 1], atol=1e-12)
    assert not joint.in_progress and not joint.is_due(100)


def test_the_window_is_that_of_the_start(joint, mapper):
    """A landmark that is retired meanwhile was in the window and stays retired."""
    joint.start(mapper, mapper.keyframes[-1], at_once=False)
    mapper.world = mapper.world.without({0})
    mapper.keyframes = [replace(key, number=key.number) for key in mapper.keyframes]
    joint.apply(mapper)
    assert 0 not in mapper.world.ids
