"""Objects and stacks that are parts of things, with the reason."""

import pytest

from perception.obstacles import parts_of_things
from perception.obstacles.parts_of_things import (
    CARRIES,
    CROSSED,
    HANDLED,
    HANDLELESS,
    without_parts_of_things,
)
from perception.obstacles.same_colour import SAME_COLOUR
from perception.types import SupportPlane
from tests.perception.bare_estimates import FRAME, found


@pytest.fixture
def rules(monkeypatch):
    """Ids that each rule returns."""
    ids = {"carriers_of_parts": set(), "mugs_without_handle": set(), "continued_in_colour": set()}
    ids |= {"crossed": set(), "with_handle": set()}
    for name in ids:
        monkeypatch.setattr(parts_of_things, name, lambda *_, name=name: set(ids[name]))
    return ids


def judged(objects, stacks=()):
    kept, left = without_parts_of_things(objects, stacks, [FRAME], SupportPlane())
    assert all(item.is_part for item in left)
    return [e.id for e in kept], {item.id: item.reason for item in left}


@pytest.mark.parametrize(("rule", "reason"), [
    ("carriers_of_parts", CARRIES), ("mugs_without_handle", HANDLELESS),
    ("continued_in_colour", SAME_COLOUR), ("crossed", CROSSED), ("with_handle", HANDLED),
])  # fmt: skip
def test_each_rule_has_its_reason(rules, rule, reason):
    rules[rule] = {1}
    assert judged([found(0), found(1)]) == ([0], {1: reason})


def test_nothing_is_left_out_without_a_rule(rules):
    assert judged([found(0), found(1)]) == ([0, 1], {})


def test_a_stack_goes_as_a_whole(rules):
    rules["crossed"] = {2}
    lower, upper, other = found(1), found(2), found(3)
    assert judged([lower, upper, other], [(lower, upper)]) == ([3], {1: CROSSED, 2: CROSSED})
