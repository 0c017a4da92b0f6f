# `make test` and `make demo` set themselves up in a fresh clone: a virtual environment in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

help:  ## Show this list.
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

$(VENV)/ready: setup.cfg pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	touch $@

test: $(VENV)/ready  ## Run all tests.
	$(BIN)/python -m pytest

lint: $(VENV)/ready  ## Check style.
	$(BIN)/ruff check .

demo: $(VENV)/ready  ## Render a procedural scene, check it against Embree, write demo/*.png.
	mkdir -p demo
	$(BIN)/raystream compare demo --methods dual,packet,crsh,rsh,embree -o demo

bench: $(VENV)/ready  ## Run the benchmarks (performance is measured here, never in tests).
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/python -m pytest tests/bench -o python_files='bench_*.py'

clean:  ## Remove the environment and what the demo wrote.
	rm -rf $(VENV) demo

.PHONY: help test lint demo bench clean
