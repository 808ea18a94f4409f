# Two commands need nothing else: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
PIP := $(VENV)/bin/python -m pip
STAMP := $(VENV)/.installed
# The build that the results were measured with; it needs no GPU.
TORCH := torch==2.13.0

.DEFAULT_GOAL := help
.PHONY: help demo test lint check-python clean

help:
	@echo "make demo   run the whole chain on the bundled scene, about 10 minutes"
	@echo "make test   run the tests, less than 20 minutes"
	@echo "make lint   check format, lint and types"
	@echo "make clean  remove the virtual environment and what was built"

demo: $(STAMP)
	$(VENV)/bin/mi-nerfattack demo

test: $(STAMP)
	$(VENV)/bin/python -m pytest

lint: $(STAMP)
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

$(STAMP): pyproject.toml | check-python
	@echo "== creating the virtual environment in $(VENV)"
	$(PYTHON) -m venv $(VENV)
	@echo "== installing $(TORCH), then this package with its dependencies"
	$(PIP) install --quiet --disable-pip-version-check "$(TORCH)"
	$(PIP) install --quiet --disable-pip-version-check -e ".[dev]"
	@touch $@
	@echo "== installed; the next run skips this"

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
