from collections import Counter

import numpy as np
import pytest

from app.errors import UsageError
from app.options import PackOptions
from app.task.cell import check_options, parse_box, parse_objects, robot_of


def rng():
    return np.random.default_rng(0)


def test_a_number_draws_classes_as_evenly_as_it_goes():
    for count in range(1, 13):
        counts = Counter(parse_objects(str(count), rng()))
        assert counts.total() == count and max(counts.values()) - min(counts.values(), default=0) <= 1
        assert len(counts) == min(count, 4)


def test_counts_by_class():
    assert parse_objects(" mug=2, can=1", rng()) == ["mug", "mug", "can"]


@pytest.mark.parametrize(
    "text", ["", "six", "-1", "0", "21", "mug", "mug=", "mug=1,", "spoon=1", "mug=1.5", "²"]
)
def test_nonsense_is_refused(text):
    with pytest.raises(UsageError, match="--objects"):
        parse_objects(text, rng())


def test_box():
    assert parse_box("0.34, 0.30,0.08") == (0.34, 0.30, 0.08)


@pytest.mark.parametrize("text", ["", "0.3", "a,b,c", "0.3,0.3,0.3,0.3", "inf,0.3,0.1", "-0.3,0.3,0.1"])
def test_impossible_boxes(text):
    with pytest.raises(UsageError, match="--box"):
        parse_box(text)


def test_the_arm_that_was_asked_for():
    assert len(robot_of(PackOptions()).description.joint_names) == 7
    assert len(robot_of(PackOptions(robot="sixaxis")).description.joint_names) == 6
    with pytest.raises(UsageError, match="--robot"):
        check_options(PackOptions(robot="arm.toml"))
