# Everything happens in .venv, which the first target called makes; no root, no system package.
VENV := .venv
BIN := $(VENV)/bin
# pybullet has wheels for Python 3.10 and 3.11 only, so the first of these that runs is taken.
PYTHON ?= $(shell for p in python3.11 python3.10 python3 python; do \
	$$p -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 12))' 2>/dev/null && echo $$p && break; done)

.PHONY: demo test test-wire check bench docs audit setup clean

demo: setup
	$(BIN)/robotcell pick --goal red --cell examples/cell.toml

test: setup
	$(BIN)/python -m pytest

# Every fault of a served arm, and a job over the wire, in real time, and jobs that are killed and resumed: about five minutes.
test-wire: setup
	$(BIN)/python -m pytest -m wire

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: setup
	$(BIN)/python -m pytest tests/benchmarks --benchmark-enable --benchmark-only

# The site, in site/. Broken links and every other warning are errors. Needs the network only to install, once.
docs: $(VENV)/.docs-installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "site/index.html"

$(VENV)/.docs-installed: $(VENV)/.installed
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable '.[docs]'
	@touch $@

# Installed libraries against known advisories. Needs the network.
audit: setup
	$(BIN)/python -m pip install --quiet 'pip-audit>=2.7,<3'
	$(BIN)/python -m pip_audit --skip-editable

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	@test -n "$(PYTHON)" || { echo "robotcell needs Python 3.10 or 3.11 on PATH, or: make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	@# The build tool warns about folders that are called like packages; an editable install is meant to use them.
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable '.[hardware,twin,train,dev]'
	@touch $@

clean:
	rm -rf $(VENV) build site *.egg-info .hypothesis .pytest_cache .mypy_cache .ruff_cache
