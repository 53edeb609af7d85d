"""Shared test set-up: quiet thread pools, headless GL, run-time checks of the array shapes in signatures."""

import os
import sys
import types
from dataclasses import is_dataclass
from functools import cache, partial, wraps

os.environ.setdefault("MUJOCO_GL", "egl")
for pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(pool, "1")

import jaxtyping
import numpy as np
import pytest
from beartype import BeartypeConf, beartype

# Of each function the first calls are checked, and of the later ones a sample. Functions within functions are
# not: their checks would be compiled at every call of the outer one. To check all doubles the suite's time.
FIRST_CALLS, EVERY = 30, 50

# The hook takes its checker by import path; ours accepts an int where a float is asked for, as Python does.
_checker = types.ModuleType("nodeslam_typechecker")
_checker.check = beartype(conf=BeartypeConf(is_pep484_tower=True))
sys.modules[_checker.__name__] = _checker
_jaxtyped = jaxtyping.jaxtyped


def _sampled(function, typechecker):
    """Return a function some of whose calls are checked; the check is compiled at the first one."""
    checked, calls = None, 0

    @wraps(function)
    def call(*args, **kwargs):
        nonlocal checked, calls
        calls += 1
        if calls > FIRST_CALLS and calls % EVERY:
            return function(*args, **kwargs)
        checked = checked or _jaxtyped(function, typechecker=typechecker)
        return checked(*args, **kwargs)

    return call


def _sampling(target, *, typechecker):
    """Decorate a function, or the constructor of a dataclass, as the import hook does."""
    if not isinstance(target, type):
        return target if "<locals>" in target.__qualname__ else _sampled(target, typechecker)
    if is_dataclass(target) and "__init__" in vars(target):
        target.__init__ = _sampled(target.__init__, typechecker)
    return target


jaxtyping.jaxtyped = lambda *, typechecker: partial(_sampling, typechecker=typechecker)
jaxtyping.install_import_hook(
    ["perception", "manipulation", "sim_assets", "app"], "nodeslam_typechecker.check"
)


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
