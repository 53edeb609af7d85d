"""Shared test set-up: quiet thread pools, headless GL, run-time checks of the array shapes in signatures."""

import os
import sys
import types
from functools import cache

os.environ.setdefault("MUJOCO_GL", "egl")
for pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(pool, "1")

import numpy as np
import pytest
from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

# The hook takes its checker by import path; ours accepts an int where a float is asked for, as Python does.
_checker = types.ModuleType("nodeslam_typechecker")
_checker.check = beartype(conf=BeartypeConf(is_pep484_tower=True))
sys.modules[_checker.__name__] = _checker

install_import_hook(["perception", "manipulation", "sim_assets", "app"], "nodeslam_typechecker.check")


@cache
def _decoded(category):
    """Imported late: modules are checked only when they are loaded after the hook."""
    from perception.inference.meshing import mesh_from_grid
    from sim_assets.objects import canonical_scale, occupancy_grid, sample_object

    model = sample_object(category, "test", np.random.default_rng(1))
    scale = np.full(3, canonical_scale(model)[0])
    return mesh_from_grid(occupancy_grid(model), scale, category)


@pytest.fixture
def decoded():
    """Return a function from a class to the mesh of a generated object decoded from its 32³ grid."""
    return _decoded
