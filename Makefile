# `make test` and `make demo` need Python >= 3.11 with venv, nothing else; the second run reuses .venv.
#
#   make test PYTHON=python3.12          another interpreter
#   make test PYTEST_ARGS=tests/pace_envs     the quick tests of a folder; make test-all: the slow ones too
#
# torch without GPU libraries: on Linux the default registry's torch may bring several GB of CUDA packages.
# Everything runs on the CPU, so a CPU wheel is enough. Point pip at one, by any of
#   make install PIP_EXTRA_INDEX_URL=<PyTorch's index of CPU wheels>
#   make install PIP_FIND_LINKS=<folder that holds a torch CPU wheel>
#   make install PIP_INSTALL_ARGS="<any options of pip install>"
# constraints.txt says torch==2.13.0, which 2.13.0+cpu satisfies and wins over the plain wheel.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PACKAGES := pace_actuators pace_envs pace_optim
PIP_INSTALL_ARGS ?=
# files in their own order: by number of tests, files of a few long ones would come last, on one processor
PYTEST_ARGS ?= -n auto --dist loadfile --no-loadscope-reorder

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# tests start many processes: without bytecode each compiles the packages and pytest rewrites all tests
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install demo docs test test-all pytest pytest-all lint format clean

help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */  make \1\t/' | expand -t 18

install: $(STAMP)  ## create .venv and install everything, pinned and editable

$(STAMP): pyproject.toml setup.py constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python >= 3.11 is needed, $(PYTHON) is $$($(PYTHON) -V 2>&1): make $(MAKECMDGOALS) PYTHON=python3.11"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(PIP_INSTALL_ARGS) --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: install  ## hide an effect in a robot, fit, compare, diagnose, add what is missing
	$(BIN)/python scripts/demo.py

docs: install  ## the documentation as a site, build/site/index.html; fails on a broken link or reference
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

lint: install  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy $(PACKAGES)

test: install  ## lint, types and the quick tests, side by side
	@$(MAKE) --no-print-directory --jobs=2 lint pytest

test-all: install  ## the same with all tests: what CI runs
	@$(MAKE) --no-print-directory --jobs=2 lint pytest-all

pytest: install
	$(BIN)/python -m pytest -m "not slow" $(PYTEST_ARGS)

pytest-all: install
	$(BIN)/python -m pytest $(PYTEST_ARGS)

format: install  ## put imports and layout right
	$(BIN)/ruff check --fix-only --select I .
	$(BIN)/ruff format .

clean:  ## remove .venv, builds and caches (logs/ stays)
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
