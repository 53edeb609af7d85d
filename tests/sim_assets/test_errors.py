"""Errors that list several problems."""

import pytest

from sim_assets.errors import RobotFileError


@pytest.mark.parametrize(("problems", "expected"), [("a", ("a",)), (["a", "b"], ("a", "b"))])
def test_problems_are_kept_and_printed_one_a_line(problems, expected):
    error = RobotFileError(problems)
    assert error.problems == expected and str(error) == "\n".join(expected)
