"""Shared test set-up: quiet thread pools, headless GL, run-time checks of the array shapes in signatures."""

import os
import sys
import types

os.environ.setdefault("MUJOCO_GL", "egl")
for pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(pool, "1")

from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

# The hook takes its checker by import path; ours accepts an int where a float is asked for, as Python does.
_checker = types.ModuleType("nodeslam_typechecker")
_checker.check = beartype(conf=BeartypeConf(is_pep484_tower=True))
sys.modules[_checker.__name__] = _checker

install_import_hook(["perception", "manipulation", "sim_assets", "app"], "nodeslam_typechecker.check")
