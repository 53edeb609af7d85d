"""Sphinx configuration: Markdown pages (MyST), API reference from docstrings in Google style, furo theme."""

from __future__ import annotations

import logging
import os
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # the API reference describes this working copy
sys.path.insert(0, str(ROOT / "docs"))  # for the extensions in docs/_extensions
os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo chooses its OpenGL when it is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
logging.getLogger("OpenGL").setLevel(logging.WARNING)  # it reports its optional accelerator on import

_PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = "NodeSLAM"
author = _PROJECT["authors"][0]["name"]
copyright = author
version = release = _PROJECT["version"]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "_extensions.command_options",
    "_extensions.docstrings",
]
exclude_patterns = ["_build", "_templates", "_extensions"]
templates_path = ["_templates"]

myst_enable_extensions = ["colon_fence", "dollarmath", "fieldlist"]
myst_heading_anchors = 3

autosummary_generate = True
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]  # a list, as for parameters
python_maximum_signature_line_length = 88
suppress_warnings = ["ref.python"]  # names of dimensions in jaxtyping annotations equal those of attributes

html_theme = "furo"
html_title = f"NodeSLAM {version}"
html_static_path = []
copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True
