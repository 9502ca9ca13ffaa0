# Two commands: `make demo` runs the main job, `make test` the checks. Both set everything up first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.bodyhull-installed
export PYOPENGL_PLATFORM ?= egl

.PHONY: help setup demo test lint types bodies clean

help:
	@echo "make demo   set up, film a synthetic clothed person, run the whole pipeline on it, compare with the truth"
	@echo "make test   set up, then lint, types and tests"
	@echo "make setup  the set-up alone (system libraries when missing, $(VENV), dependencies)"

setup: $(STAMP)

$(STAMP): pyproject.toml scripts/system-libraries.sh
	bash scripts/system-libraries.sh
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "bodyhull needs Python 3.11 or newer; set PYTHON=... to one")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

demo: setup
	$(BIN)/bodyhull demo --out demo

test: setup lint types bodies
	$(BIN)/python -m pytest

# Built ahead: inside the tests every call of the generator would be checked, which makes it several times slower.
bodies: setup
	for sex in neutral female male; do $(BIN)/bodyhull body info free:$$sex || exit 1; done

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

clean:
	rm -rf $(VENV) demo .pytest_cache .mypy_cache .ruff_cache
