"""Escaping the bars of absolute values for reStructuredText."""

import pytest

CASES = {
    "absolute value": (["the length |v| of v"], [r"the length \|v\| of v"]),
    "inline code": (["``a | b`` and `c|d` or |e|"], [r"``a | b`` and `c|d` or \|e\|"]),
    "literal block": (
        ["norm |x|::", "", "    |x| = 1", "", "and |y|"],
        [r"norm \|x\|::", "", "    |x| = 1", "", r"and \|y\|"],
    ),
    "literal block within an indented one": (
        ["  a::", "    |b|", "  |c|"],
        ["  a::", "    |b|", r"  \|c\|"],
    ),
}


@pytest.mark.parametrize("lines, expected", CASES.values(), ids=CASES)
def test_bars_outside_code_are_escaped(docstring_bars, lines, expected):
    assert list(docstring_bars.escape_bars(lines)) == expected
