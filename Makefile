# Everything a person does here, one target each. `make help` lists them.
# Needed beforehand: Python 3.11 or later with venv and pip, make, and a package registry that pip can reach.

PYTHON ?= python3
WORKERS ?= 2
OUT ?= out
SYSTEMS ?= 10000

VENV := .venv
BIN := $(VENV)/bin
RUN := $(BIN)/python -m
INSTALL := $(RUN) pip install -qq --disable-pip-version-check --no-deps
LOCKED := $(VENV)/.locked
READY := $(VENV)/.ready
REPORT := src/dirax/show/assets

# Compiled JAX functions, shared by the test workers and kept between runs.
export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.jax_cache
# Byte code is kept, whatever the shell says: without it every process compiles the packages anew, which takes most of its time.
unexport PYTHONDONTWRITEBYTECODE

# Tests run in as many processes as there are cores: threads of BLAS would wait for each other.
test soak fuzz: export OPENBLAS_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help install demo test lint types format docs soak fuzz bench vendor lock clean

help:  ## List the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/  make \1 \t\2/p' $(MAKEFILE_LIST)

install: $(READY)  ## Make the virtual environment .venv and install the locked packages and dirax in it

demo: $(READY)  ## Reproduce the papers: out/index.html shows figures, tables and the systems in motion
	$(BIN)/dirax reproduce all --out $(OUT)

test: lint  ## The whole test suite: style, types beside it, import order, tests
	@$(MAKE) --no-print-directory types & types=$$!; $(RUN) pytest -n $(WORKERS) --dist worksteal; tests=$$?; wait $$types && exit $$tests

lint: $(READY)  ## Check style with ruff
	$(RUN) ruff check
	$(RUN) ruff format --check

types: $(READY)  ## Check types with pyrefly
	$(BIN)/pyrefly check --python-interpreter-path $(BIN)/python

format: $(READY)  ## Repair style with ruff
	$(RUN) ruff check --fix
	$(RUN) ruff format

docs: $(READY)  ## Check the spelling and build the documentation in site/, every warning an error
	$(BIN)/codespell *.md docs src tests benchmarks
	NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs build --strict

soak: $(READY) fuzz  ## The long tests that `make test` leaves out
	$(RUN) pytest -n $(WORKERS) --dist worksteal -m soak

fuzz: $(READY)  ## Examine SYSTEMS=10000 random systems by every scheme against equations derived apart
	PYTHONPATH=tests $(RUN) fuzz $(SYSTEMS)

bench: $(READY)  ## Measure speed
	$(RUN) benchmarks

vendor:  ## Fetch anew what reports and pages are made with: three.js, uPlot, KaTeX at locked versions (needs node and npm)
	cd $(REPORT) && npm ci --no-audit --no-fund --ignore-scripts && node build.mjs && rm -rf node_modules
	cd docs/gen && npm ci --no-audit --no-fund --ignore-scripts && node vendor.mjs && rm -rf node_modules

lock:  ## Write requirements.lock anew from pyproject.toml (UPGRADE=--upgrade takes the newest versions)
	$(PYTHON) -m venv --clear $(VENV)-lock
	$(VENV)-lock/bin/python -m pip install -qq --disable-pip-version-check uv
	$(VENV)-lock/bin/uv pip compile --quiet --group dev pyproject.toml --output-file requirements.lock $(UPGRADE)
	rm -rf $(VENV)-lock

clean:  ## Remove everything that the other targets made
	rm -rf $(VENV) $(VENV)-lock out site dist .jax_cache .pytest_cache .ruff_cache .hypothesis .benchmarks
	find src tests docs benchmarks -name __pycache__ -prune -exec rm -rf {} +

# The lock names every package, pip itself included, with its exact version and hashes, so pip resolves nothing.
# Byte code is left to the first import: most of what is installed is never imported.
$(LOCKED): requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "dirax needs Python 3.11 or later: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@echo "Installing the locked packages in $(VENV): about a minute."
	$(PYTHON) -m venv --clear $(VENV)
	$(INSTALL) --no-compile --require-hashes --only-binary :all: --requirement requirements.lock
	@touch $@

$(READY): $(LOCKED) pyproject.toml
	$(INSTALL) --no-build-isolation --editable .
	@$(BIN)/dirax run kepler > /dev/null  # what a run imports is byte code from here on
	@touch $@
