# Each target sets up first: .venv is built once from requirements.lock; a stamp file marks it.
TRAJ ?= straight
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The first interpreter that is Python 3.11 to 3.13 and can make environments.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
	>/dev/null 2>&1 && echo $$p && break; done)

QUICK_TESTS := $(addprefix tests/test_,$(addsuffix .py,legs reference weights mpc controller \
	qp loss difftune rollout))

LOCK = $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --no-header \
	--no-emit-index-url pyproject.toml

.PHONY: help setup engines tune verdict grfm test quick test-all bench check format docs lock

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

setup: $(STAMP) ## build .venv from the lock

$(STAMP): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "hector_jax needs Python 3.11 to 3.13; there is none" >&2; exit 2; }
	@echo "setting up $(VENV) with $$($(PYTHON) --version) (once, one to two minutes)"
	@$(PYTHON) -m venv --clear $(VENV)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -r requirements.lock
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --no-deps --editable .
	@touch $@

engines: $(STAMP) ## install the other engines, Drake and Pinocchio, dask for --cluster, rosbags for --mapping
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -r requirements-engines.lock

tune: $(STAMP) ## tune and evaluate: make tune TRAJ=straight|c|s|all, TRAJ="c s", ROBOT=robot.toml
	@$(BIN)/hector tune --traj $(TRAJ) $(if $(ROBOT),--robot $(ROBOT))

MODELS := --plant light heavy examples/hector-v2/robot.toml

verdict: $(STAMP) ## sets in all engines and models: make verdict WEIGHTS="nominal mine.json"
	@$(BIN)/hector evaluate --traj all --engine all $(MODELS) --out runs/verdict --weights $(or $(WEIGHTS),nominal expert shipped)

grfm: $(STAMP) ## how well the nets predict the ground forces: runs/grfm/report.md
	@$(BIN)/hector steps grfm

test: $(STAMP) ## the fast tests
	@$(BIN)/pytest -q -n 2 --dist loadfile

quick: $(STAMP) ## the fast tests of controller, QP and tuner
	@$(BIN)/pytest -q -n 2 --dist loadfile $(QUICK_TESTS)

# CI leaves out the longest tests by MARKS="not long"
MARKS ?= slow or not slow
test-all: $(STAMP) ## the fast and the slow tests; then those of quick, each call's shapes checked
	@$(BIN)/pytest -q -n 2 --dist loadfile -m "$(MARKS)"
	@$(BIN)/pytest -q -n 2 --dist loadfile --jaxtyping-packages=hector_jax,beartype.beartype $(QUICK_TESTS)

bench: $(STAMP) ## benchmarks on this machine, as JSON; peers come with pip install -e ".[bench]"
	@$(BIN)/python -m benchmarks

check: $(STAMP) ## format, lint and types
	@$(BIN)/ruff format --check --quiet .
	@$(BIN)/ruff check --quiet .
	@$(BIN)/pyright

format: $(STAMP) ## format the code
	@$(BIN)/ruff format --quiet .
	@$(BIN)/ruff check --quiet --fix .

docs: $(STAMP) ## the site, into docs/_build; a warning is an error
	@$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build

lock: $(STAMP) ## resolve pyproject.toml into requirements.lock and requirements-engines.lock
	@$(BIN)/python -m pip install --quiet uv
	@$(LOCK) --extra dev -o requirements.lock
	@$(LOCK) --extra bags --extra cluster --extra drake --extra pinocchio -c requirements.lock -o requirements-engines.lock
