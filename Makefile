# `make help` lists the targets. Two commands on a fresh machine: `make demo` and `make test`.
# Every target installs what it needs first (scripts/setup; quick when there is nothing to do).

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
BIN := .venv/bin
PYTEST := $(BIN)/pytest
CHECKED := appliance tests examples benchmarks distribution

.PHONY: help setup demo check test test-system package bench clean

help: ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 24

setup: ## install what is missing: Debian packages and .venv
	@scripts/setup

demo: setup ## the appliance at work: a simulated robot, its operator and an attacker, in a minute or two
	@$(BIN)/rosrv demo $(ARGS)

check: setup ## format, lint, types, dependency directions, unit tests
	$(BIN)/ruff format --check $(CHECKED)
	$(BIN)/ruff check $(CHECKED)
	$(BIN)/mypy
	$(BIN)/mypy tests benchmarks distribution
	$(BIN)/lint-imports
	@# Four at a time on two cores: many wait for something.
	$(PYTEST) tests/unit -n 4 --quiet

test: check ## check, and the tests with real ROS nodes (root: they make network namespaces)
	@# Two at a time. What fails while the machine is busy with another test is tried once more, alone, and both are shown.
	$(PYTEST) tests/integration --quiet -n 2 --dist loadfile --durations=10 || \
		{ echo "== once more, alone: what failed"; $(PYTEST) tests/integration --quiet --last-failed --last-failed-no-failures none; }

test-system: ## the whole product: demo, namespaces, tunnels, containers, a virtual machine, the console in a browser
	@scripts/setup --system
	$(PYTEST) tests/system --quiet --durations=15 || \
		{ echo "== once more: what failed"; $(PYTEST) tests/system --quiet --last-failed --last-failed-no-failures none; }

package: setup ## the Debian packages of both architectures: dist/rosrv_VERSION_ARCH.deb
	@scripts/setup --package
	$(BIN)/python -m distribution.deb amd64 arm64

bench: setup ## measure: every program in benchmarks/
	@for program in benchmarks/*.py; do echo "== $$program"; $(BIN)/python -m "benchmarks.$$(basename "$$program" .py)"; done

clean: ## remove what was built, .venv included
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
