# Two commands need nothing else: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
PYTEST = $(VENV)/bin/python -m pytest -n $(WORKERS) --dist worksteal --durations 25
PIP := $(VENV)/bin/python -m pip --disable-pip-version-check
# The build that the results were measured with; it needs no GPU.
TORCH := torch==2.13.0

# Processes that the tests are spread over; each takes up to 2 GB of memory.
WORKERS ?= 2

.DEFAULT_GOAL := help
.PHONY: help demo test test-fast test-slow test-all test-fuzz test-random mutants lint docs dist results bench-gpu check-python clean

help:
	@echo "make demo         run the whole chain on the bundled scene, up to 11 minutes"
	@echo "make test         run the tests, up to 23 minutes; less with compiled kernels"
	@echo "make test-fast    run the quickest tests of every folder, at most 90 seconds"
	@echo "make test-all     the slow ones too, at most 40 minutes"
	@echo "make test-fuzz    100,000 damaged files of each format and seed, hours; goes on"
	@echo "make test-random  formats and geometry on other examples each time"
	@echo "make mutants      change the code 400 times and count what the tests notice, hours"
	@echo "make lint         check format, lint and types"
	@echo "make docs         build the documentation's site in build/docs"
	@echo "make results      make the committed rows again; ONLY=table2, QUICK=1, CHECK=1, LIST=1"
	@echo "make bench-gpu    measure on an NVIDIA GPU, within 10 minutes, into bench/results"
	@echo "make dist         build wheel and sdist, and run the wheel in an empty environment"
	@echo "make clean        remove the virtual environment and what was built"

demo: $(VENV)/.installed-demo
	$(VENV)/bin/mi-nerfattack demo

test: $(VENV)/.installed-test
	$(PYTEST) -m "not slow"

# Tests by name, because pytest would need too long to import all files of tests.
test-fast: $(VENV)/.installed-test
	$(PYTEST) -m "not slow" $$(cat tests/fast.txt)

test-slow: $(VENV)/.installed-test
	$(PYTEST) -m slow

test-all: test test-slow

# Continues an interrupted campaign. Other formats or seeds: make test-fuzz FUZZ="scenario --seeds 3 --table build/fuzz.csv"
test-fuzz: $(VENV)/.installed-test
	PYTHONPATH=tests $(VENV)/bin/python -m fuzz.campaign $(FUZZ)

test-random: $(VENV)/.installed-test
	$(PYTEST) -m hypothesis --hypothesis-profile random

# Others by count, seed and parts: make mutants MUTANTS="--count 20 --seed 3 --parts attack"
mutants: $(VENV)/.installed-test
	PYTHONPATH=tests $(VENV)/bin/python -m mutants.run $(MUTANTS)

lint: $(VENV)/.installed-dev
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

# Nothing is fetched; a warning, a dead link inside among them, is an error.
docs: $(VENV)/.installed-dev
	$(VENV)/bin/sphinx-build -W -n --keep-going -q -E -a docs build/docs

# The wheel comes of the sdist, holds what one of the tree holds, and works by itself.
dist: $(VENV)/.installed-dev
	$(VENV)/bin/python .ci/dist.py "$(TORCH)"

# Each run continues. All studies take days: see LIST=1, and bench/results.toml.
results: $(VENV)/.installed-test
	$(VENV)/bin/python -m bench results $(if $(ONLY),--only $(ONLY)) $(if $(LIST),--list) \
	  $(if $(CHECK),--check) $(if $(QUICK),--quick)

# Refused without a GPU. PyTorch must be a build for CUDA; ours above may not be one.
bench-gpu: $(VENV)/.installed-test
	$(VENV)/bin/python -m bench gpu

# A stamp says that the step is done, and is younger than what it was done from.
$(VENV)/.installed: pyproject.toml | check-python
	@echo "== making a virtual environment in $(VENV)"
	$(PYTHON) -m venv $(VENV)
	@echo "== installing PyTorch, then this package and what it needs (minutes)"
	$(PIP) install --quiet "$(TORCH)"
	$(PIP) install --quiet -e .
	@touch $@

$(VENV)/.installed-demo: $(VENV)/.installed
	@echo "== installing what the demo needs"
	$(PIP) install --quiet -e ".[demo]"
	@touch $@
	@echo "== installed; the next run skips this"

$(VENV)/.installed-test: $(VENV)/.installed
	@echo "== installing what the tests need"
	$(PIP) install --quiet -e ".[test]"
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed-test
	@echo "== installing the linters"
	$(PIP) install --quiet -e ".[dev]"
	@touch $@

check-python:
	@command -v $(PYTHON) >/dev/null 2>&1 || { \
	  echo "make: $(PYTHON) not found; install Python 3.10 or newer" \
	    "(Debian: apt-get install python3 python3-venv)" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	  echo "make: $(PYTHON) is older than 3.10;" \
	    "run make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  echo "make: $(PYTHON) cannot make virtual environments" \
	    "(Debian: apt-get install python3-venv)" >&2; exit 1; }

clean:
	rm -rf $(VENV) build dist *.egg-info
