"""The installation hint names an extra as it can be installed from a clone."""

import tomllib
from pathlib import Path

import pytest

from app.doctor import OPTIONAL
from app.failures import EXTRA_OF
from perception.errors import install_hint

EXTRAS = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))["project"][
    "optional-dependencies"
]


def test_an_extra_is_installed_from_a_clone():
    assert install_hint("sim") == "run pip install '.[sim]' in a clone of NodeSLAM"


@pytest.mark.parametrize("library, extra", (EXTRA_OF | OPTIONAL).items())
def test_the_extras_of_the_hints_bring_their_libraries(library, extra):
    assert any(library in requirement for requirement in EXTRAS[extra])  # pyzmq brings zmq
