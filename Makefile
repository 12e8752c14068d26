# Everything runs inside .venv, which the first target that needs it builds.
PYTHON ?= python3
BIN := .venv/bin
# Of a user, and of a developer, who needs everything
BASICS := zoo,video,mujoco
EXTRAS := $(BASICS),robotics,panda,metaworld,tensorboard,postgresql,ray,docs,dev
INSTALL := $(BIN)/pip install --quiet -c constraints.txt -e
STAMP := .venv/.installed
BENCHMARKS := $(filter-out benchmarks/_%,$(wildcard benchmarks/*.py))

.DEFAULT_GOAL := help
.PHONY: help venv demo test lint format type docs wheel bench clean

help: ## show this list
	@sed -n 's/^\([a-z]*\):.*## /\1|/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "  make %-8s %s\n", $$1, $$2}'

venv: $(STAMP) ## make .venv with the tested versions of everything

.venv/.basics: setup.cfg constraints.txt
	$(PYTHON) -m venv .venv
	$(INSTALL) ".[$(BASICS)]"
	@touch $@

$(STAMP): .venv/.basics
	$(INSTALL) ".[$(EXTRAS)]"
	@touch $@

demo: .venv/.basics ## meta-train on SparsePointRobot-v0, then adapt to unseen tasks
	$(BIN)/sb3-htr train --env SparsePointRobot-v0 -n 24000 -P --verbose 0 --eval-freq 4000 -f runs/demo
	$(BIN)/sb3-htr evaluate runs/demo
	$(BIN)/sb3-htr plot runs/demo --only learning -o runs/demo

test: $(STAMP) ## run the tests
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal

lint: $(STAMP) ## check style, types and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

format: $(STAMP) ## sort imports and format the code
	$(BIN)/ruff check --select I --fix .
	$(BIN)/ruff format .

type: $(STAMP) ## check types only
	$(BIN)/mypy

docs: $(STAMP) ## build the manual into docs/_build/html; a warning is an error
	$(BIN)/sphinx-build -W -b html docs docs/_build/html

wheel: $(STAMP) ## build the sdist and the wheel into dist/
	$(BIN)/python -m build

bench: $(STAMP) ## run every benchmark; each writes its figures to benchmarks/results/
	@set -e; for script in $(BENCHMARKS); do echo "$$script"; $(BIN)/python "$$script"; done; $(BIN)/python tools/benchmark_tables.py

clean: ## remove build outputs and caches (keeps .venv and runs)
	rm -rf build dist *.egg-info docs/_build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
