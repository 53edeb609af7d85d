"""Durations by a clock of known ticks."""

import pytest

from perception.slam.stage_timer import StageTimer


@pytest.fixture
def timer():
    ticks = iter([0.0, 1.0, 10.0, 12.0, 20.0, 25.0])
    return StageTimer(lambda: next(ticks))


def test_stages_of_one_name_add_up_until_the_reset(timer):
    for name in ("track", "detect", "track"):
        with timer.stage(name):
            pass
    assert timer.seconds == {"track": 6.0, "detect": 2.0}
    timer.reset()
    assert timer.seconds == {}


def test_seconds_are_a_copy(timer):
    with timer.stage("track"):
        pass
    timer.seconds["track"] = 7.0
    assert timer.seconds == {"track": 1.0}
