# Every target makes its own environment first: nothing but a Python is needed.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
comma := ,
# On a machine with an NVIDIA driver the environment has JAX for the GPU.
GPU := $(if $(shell command -v nvidia-smi 2>/dev/null),$(comma)cuda12)
# How many processes run the tests.
WORKERS ?= 2
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

# The Pythons that `make test-versions` uses, and the constraints of `make test-lowest`.
PYTHONS ?= python3.11 python3.12 python3.13
LOWEST := $(CURDIR)/tests/versions/lowest.txt

.PHONY: help demo test test-all test-lowest test-versions mutants lint check check-all docs clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 16

demo: $(VENV)/.demo ## render a small scene, reconstruct it, compare it with the exact cameras: demo/
	rm -rf demo
	$(BIN)/jaxsfm demo --out demo

test: $(VENV)/.dev ## run the quick tests: about 10 minutes on two cores
	$(PYTEST) -m "not slow"
	JAXSFM_TESTS_OPTIMIZED=1 $(PYTEST) -m "optimized and not slow"

test-all: $(VENV)/.dev ## run all tests, the slow ones too
	$(PYTEST)
	JAXSFM_TESTS_OPTIMIZED=1 $(PYTEST) -m optimized

test-lowest: ## run the quick tests with the lowest versions that pyproject.toml declares
	PIP_CONSTRAINT=$(LOWEST) $(MAKE) test PYTHON=python3.11 VENV=.venv-lowest

test-versions: ## run the quick tests with each of PYTHONS and its newest packages
	for python in $(PYTHONS); do $(MAKE) test PYTHON=$$python VENV=.venv-$$python || exit 1; done

mutants: $(VENV)/.dev ## make deliberate mistakes in the core and the refinement: do tests fail?
	$(BIN)/python tests/mutants/run.py

lint: $(VENV)/.dev ## check format, style, layers and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/pyright --pythonpath $(BIN)/python

check: lint test ## what must pass before a commit

check-all: lint test-all demo ## what continuous integration runs (.ci/run)

docs: $(VENV)/.dev ## build the documentation's site: build/site
	$(BIN)/zensical build --strict

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "jaxsfm needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[demo,weights$(GPU)]'
	touch $@

$(VENV)/.dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[dev,demo$(GPU)]'
	touch $@ $(VENV)/.demo

clean: ## remove the environment and all caches
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis
