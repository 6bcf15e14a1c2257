# `make run` and `make test` set up everything they need in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
OUT ?= runs/first

.PHONY: run test quick lint targets clean

run: $(INSTALLED)
	$(BIN)/cpdeform run writer --iterations 30 --out $(OUT) --overwrite

test: $(INSTALLED)
	$(BIN)/python -m pytest
	cd plugins/cpdeform-example && ../../$(BIN)/python -m pytest

quick: $(INSTALLED)
	$(BIN)/python -m pytest -m "not slow"

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	cd plugins/cpdeform-example && ../../$(BIN)/mypy

targets: $(INSTALLED)
	$(BIN)/python -m cpdeform.tasks.make_targets --check

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-deps --editable plugins/cpdeform-example
	touch $(INSTALLED)

clean:
	rm -rf $(VENV)
