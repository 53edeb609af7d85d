import pytest

from app.errors import AppError, MissingExtraError, UsageError


@pytest.mark.parametrize("kind", [UsageError, MissingExtraError])
def test_every_error_of_app_is_reported_as_one_line(kind):
    """The command line catches the base class alone."""
    assert issubclass(kind, AppError) and not issubclass(kind, ValueError)
