# Everything happens in .venv; each target does its set-up. See CONTRIBUTING.md.
#
# Recipes run the tools as modules or by relative path, so that a checkout may lie in a folder with spaces.

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow coverage fuzz frozen check docs format requirements clean

BIN := .venv/bin
# calgraph with what a user needs, and with the tools of all other targets.
RUNTIME := .venv/.calgraph
READY := .venv/.ready
# pip asks no questions, and looks for no newer self.
export PIP_NO_INPUT := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*  ## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*  ## (.*)/make \1\t\2/' | expand -t 20

setup: $(READY)  ## make .venv with calgraph and all tools in it

demo: $(RUNTIME)  ## simulate a five-sensor robot and calibrate it; results in demo/
	$(BIN)/calgraph demo --out demo --force

# One process per core runs tests, so NumPy needs no more threads. Tests start many commands: they keep bytecode, even
# where the environment forbids it.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --dist loadfile

test: $(READY)  ## run the tests of the first tier, within minutes (ARGS="-k name" to choose some)
	$(PYTEST) -m "not slow" $(ARGS)

test-slow: $(READY)  ## run the others: statistics over seeds, whole commands, browsers
	$(PYTEST) -m slow $(ARGS)

# Settings and the least coverage allowed are in pyproject.toml. --cov-report=html also draws it line by line.
coverage:  ## run the first tier and measure its coverage; fails below the limit in pyproject.toml
	$(MAKE) test ARGS="--cov --cov-report= $(ARGS)"

SECONDS := 3600
fuzz: .venv/.fuzz  ## give damaged files to all readers for SECONDS, on Linux; findings in build/fuzz
	$(BIN)/python benchmarks/fuzz_readers.py --work build/fuzz --seconds $(SECONDS)

# OMP_NUM_THREADS=1: sums of several threads differ from run to run.
frozen: $(READY)  ## calculate the frozen corpus of problems, to compare bits (ARGS="compare A B" for two folders)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/frozen.py $(ARGS)

check: $(READY)  ## lint, format, types, who may import whom, and words
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python docs/lint_words.py

docs: $(READY)  ## build the documentation; open docs/_build/index.html
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build

format: $(READY)  ## put all code into the format that check asks for
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

requirements: $(READY)  ## pin the newest versions that pyproject.toml allows, with hashes
	requirements/compile $(BIN)

clean:  ## remove .venv, results of the demo and all caches
	rm -rf .venv demo build .coverage* docs/_build docs/gallery docs/generated src/*.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis

# The environment is made again only when what users need is pinned anew; a change of pyproject.toml needs no network.
.venv/.runtime: requirements/runtime.txt requirements/install
	rm -rf .venv
	requirements/install .venv requirements/runtime.txt
	touch $@

$(RUNTIME): .venv/.runtime pyproject.toml
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

.venv/.tools: .venv/.runtime requirements/dev.txt
	requirements/install .venv requirements/dev.txt
	touch $@

$(READY): $(RUNTIME) .venv/.tools
	touch $@

.venv/.fuzz: requirements/fuzz.txt $(READY)
	requirements/install .venv $<
	touch $@
