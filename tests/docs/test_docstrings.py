"""Docstrings and signatures for reStructuredText."""

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
def test_bars_outside_code_are_escaped(docstrings, lines, expected):
    assert list(docstrings.escape_bars(lines)) == expected


@pytest.mark.parametrize(
    "signature, expected",
    [("(a: int = <factory>, b=<factory>)", "(a: int = ..., b=...)"), ("(a=1)", "(a=1)"), (None, None)],
)
def test_defaults_of_factories_are_ellipses(docstrings, signature, expected):
    assert docstrings.parsable(signature) == expected
