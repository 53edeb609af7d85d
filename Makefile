# make setup | demo | test | check | bench | docs
PYTHON ?= python3
BIN := .venv/bin
# The CPU build is enough; set TORCH='torch==2.13.0' with a pip index of your own for another build.
TORCH ?= torch==2.13.0
export MUJOCO_GL ?= egl
# One thread per process in numerical pools: several pools on few cores fight each other.
export OPENBLAS_NUM_THREADS ?= 1
# Hundreds of tests start a process, which would compile all modules where no bytecode may be written.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: setup demo test check bench docs
setup: .venv/.complete

.venv/.complete: pyproject.toml requirements.lock
	@PYTHON=$(PYTHON) bash .ci/system-libraries
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade-strategy only-if-needed "$(TORCH)"
	$(BIN)/pip install --quiet -c requirements.lock -e '.[sim,train,eval,hf,gym,collect,remote,docs,dev]'
	@touch $@

demo: setup
	$(BIN)/nodeslam pack --objects 6 --seed 1 --out runs/demo

test: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports
	.ci/audit

bench: setup
	$(BIN)/nodeslam bench

# -W: warnings are errors; --keep-going lists all of them. Pages of modules that were renamed must not remain.
docs: setup
	rm -rf docs/api/generated
	$(BIN)/sphinx-build -W --keep-going -b html docs docs/_build/html
