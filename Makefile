# Everything from a bare Python: each target makes its own environment first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
comma := ,
# With an NVIDIA driver on the machine the same commands use the GPU.
GPU := $(if $(shell command -v nvidia-smi 2>/dev/null),$(comma)cuda)
WORKERS ?= 2

.PHONY: demo test mutants check lint docs clean

demo: $(VENV)/.demo ## render a small scene, reconstruct it, compare with the truth, in demo/
	rm -rf demo
	$(BIN)/jaxsfm demo --out demo

test: $(VENV)/.dev ## all tests
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

mutants: $(VENV)/.dev ## deliberate mistakes in the core and the refinement: do tests fail?
	$(BIN)/python tests/mutants/run.py

lint: $(VENV)/.dev ## format, style, layers, types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: $(VENV)/.dev ## the documentation's site, in build/site
	$(BIN)/zensical build --strict

check: lint test ## what must pass before a commit

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "jaxsfm needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[demo$(GPU)]'
	touch $@

$(VENV)/.dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[dev,demo$(GPU)]'
	touch $@ $(VENV)/.demo

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis
