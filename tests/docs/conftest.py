"""The documents, and the extensions of the documentation's build."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def _extension(name):
    path = ROOT / "docs" / "_extensions" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"docs_extension_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def command_options():
    return pytest.importorskip("docutils") and _extension("command_options")


@pytest.fixture(scope="session")
def docstrings():
    return _extension("docstrings")
