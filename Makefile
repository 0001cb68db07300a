# Two commands set everything up: `make experiment EXP=ablation_ordinal` and `make test`. `make help` lists the rest.
PYTHON ?= python3
VENV   ?= .venv
EXP    ?= ablation_ordinal
ARGS   ?=
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
# Bytecode is kept in the environment, whatever PYTHONDONTWRITEBYTECODE says: without it every worker, and every process
# that a test starts, compiles all sources again.
KEPT   := PYTHONDONTWRITEBYTECODE= PYTHONPYCACHEPREFIX=$(abspath $(VENV))/bytecode
PYTEST := $(KEPT) $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder

PYTHONS ?= python3.11 python3.12

.PHONY: help setup experiment demo test test-long test-slow test-matrix lint format docs dist clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1|/' | awk -F'|' '{printf "  make %-12s %s\n", $$1, $$2}'

setup: $(READY)  ## make the environment (.venv) with the pinned packages

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v >= (3, 11) else f"touchr1-jax needs Python >= 3.11, PYTHON={sys.executable} is {v[0]}.{v[1]}: set PYTHON=python3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --upgrade-strategy only-if-needed -c constraints.txt -e '.[dev]'
	@touch $@

experiment: setup  ## run an experiment: EXP=name, ARGS="--scale smoke ..."
	$(BIN)/python -m experiments $(EXP) $(ARGS)

demo: setup  ## ask a trained policy in the browser: ARGS="POLICY", that of the package by default
	$(BIN)/python -m experiments demo $(ARGS)

test: setup  ## pass the tests (five minutes on two cores)
	$(PYTEST) -m 'not long and not slow' $(ARGS)

test-long: setup  ## pass the tests that train or compile for seconds (half an hour)
	$(PYTEST) -m 'long and not slow' $(ARGS)

test-slow: setup  ## pass the tests that take minutes
	$(BIN)/python -m pytest -q -m slow $(ARGS)

test-matrix:  ## pass the tests on each of PYTHONS, in an environment of its own
	@for python in $(PYTHONS); do $$python -c '' 2> /dev/null || { echo "$$python cannot be run: install it, or name others, as in make test-matrix PYTHONS=\"python3.11 python3.13\""; exit 1; }; done
	for python in $(PYTHONS); do $(MAKE) test test-long PYTHON=$$python VENV=.venv-$$python || exit 1; done

lint: setup  ## check style, imports and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup  ## rewrite the sources in the house format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: setup  ## build the site of the documents in build/site
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[docs]'
	$(BIN)/mkdocs build --quiet --strict

dist: setup  ## build wheel and sdist in dist/ and check them
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[release]'
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*

clean:  ## remove the environments and caches, keep data/ and runs/
	rm -rf $(VENV) .venv-* build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
