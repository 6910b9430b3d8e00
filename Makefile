# `make help` lists the targets. Two commands on a fresh machine: `make demo` and `make test`.
# Every target installs what it needs first (scripts/setup; quick when there is nothing to do).

SHELL := /bin/bash
# What pytest makes of a test file once, it need not make again for each worker and each run.
unexport PYTHONDONTWRITEBYTECODE
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
BIN := .venv/bin
PYTEST := $(BIN)/pytest
CHECKED := appliance roswire rosmop fleet tests examples benchmarks distribution
LONG_PROOFS := $(addprefix tests/proofs/test_,histories.py insertion_mutants.py insertion_traces.py insertion_at_large.py lease.py lease_mutants.py lease_traces.py certifier.py events.py)
# Rules on the source run with `make check`, however long they take.
LONG_UNIT := $(filter-out tests/unit/test_% tests/unit/support/%,$(shell grep '^tests/unit\|^rosmop' tests/long.txt))
# What fetches packages needs this machine's network: a worker of pytest-xdist has none but a loopback of its own. A
# cluster of Ray needs processors: its tests run here, where only containers run in parallel.
CONTAINERS := tests/system/containers
FETCHING := tests/system/vm $(addprefix tests/system/test_,clickhouse.py examples.py generated_client.py recordings_cluster.py)
NAMESPACES := $(filter-out $(CONTAINERS) $(FETCHING),$(wildcard tests/system/test_*.py) $(patsubst %/.,%,$(wildcard tests/system/[a-z]*/.)))
# What takes longest runs with `make test-system` only: attacks, crashes and stock tools; searches.
LONGEST_NODES := $(wildcard tests/integration/*/test_attacks.py tests/integration/*/test_floods.py tests/integration/*/test_crashes.py tests/integration/*/test_robustness.py tests/integration/test_stock_tools.py tests/integration/*/test_stock_tools.py)
LONGEST_UNITS := $(addprefix rosmop/tests/,batch/test_hostile_recordings.py certify/test_steps.py check/test_against_cpp.py learn/test_learner.py logics/test_verdicts.py test_hostile.py test_suppression.py tool/test_installed.py) \
	$(addprefix tests/unit/,distribution/test_extension.py recorder/test_killed.py relay/transport/test_pump_fuzzer.py standby/test_replication_kills.py)
PROPERTIES = $(shell grep --recursive --files-with-matches --include='test_*.py' 'tests.support.examples\|^from hypothesis\|rosmop.tests.examples' tests/unit tests/integration rosmop/tests)

.PHONY: help setup demo check static unit test units nodes test-system test-fleet system-machine system-containers system-nodes system-namespaces test-package prove wheel constraints package image site fleet release bench clean

help: ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 24

setup: ## install what is missing to develop: Debian packages and .venv
	@scripts/setup

demo: ## the appliance at work: a simulated robot, its operator and an attacker, in a minute or two
	@scripts/setup --run
	@$(BIN)/rosrv demo $(ARGS)

check: setup ## format, lint, types, dependency directions, unit tests but the long ones
	$(MAKE) --jobs=2 --output-sync=target static unit

static:
	$(BIN)/ruff format --check $(CHECKED)
	$(BIN)/ruff check $(CHECKED)
	$(BIN)/mypy
	$(BIN)/lint-imports

# Once after a clone: the workers, which all begin with the same files, would each compile every test. What is wrong with
# a test is said when it is to run.
build/collected:
	mkdir -p build
	$(PYTEST) tests/unit rosmop/tests tests/integration tests/proofs --collect-only --quiet > /dev/null || true
	touch $@

unit:
	$(PYTEST) tests/unit rosmop/tests $(addprefix --ignore=,$(LONG_UNIT)) -n $$(nproc) --quiet

test: setup ## check, long unit tests, and tests with real ROS nodes (root: they make network namespaces)
	$(MAKE) --jobs=3 --output-sync=target static units nodes

# Tests with real nodes wait half of their time: what computes has the processors then, and after them, for it is nice.
units: build/collected
	nice $(PYTEST) tests/proofs/test_insertion.py tests/unit rosmop/tests $(addprefix --ignore=,$(LONGEST_UNITS)) -n logical --dist loadfile --no-loadscope-reorder --quiet --durations=10

nodes: build/collected
	$(PYTEST) tests/integration $(addprefix --ignore=,$(LONGEST_NODES)) -n auto --dist loadfile --no-loadscope-reorder --quiet --durations=10

test-system: ## the whole product: attacks, demo, tunnels, containers, a virtual machine, the console in a browser
	@scripts/setup --system
	TESTS_EXAMPLES=all $(PYTEST) $(LONG_PROOFS) $(LONGEST_UNITS) $(PROPERTIES) -n auto --dist loadfile --quiet --durations=5
	$(MAKE) --jobs=2 --keep-going --output-sync=target --no-print-directory system-machine system-containers
	$(MAKE) --no-print-directory system-nodes
	$(MAKE) --no-print-directory system-namespaces

system-machine:
	$(PYTEST) $(FETCHING) --quiet --durations=5

system-containers:
	$(PYTEST) $(CONTAINERS) --quiet --durations=5

system-namespaces:
	$(PYTEST) $(NAMESPACES) -n auto --dist loadfile --no-loadscope-reorder --quiet --durations=10

system-nodes: build/collected
	$(PYTEST) $(LONGEST_NODES) -n auto --dist loadfile --no-loadscope-reorder --quiet --durations=10

test-fleet: ## the collector: real logs, PostgreSQL, kills and attacks; `make test-system` runs it, too
	@scripts/setup --system
	$(PYTEST) tests/unit/fleet tests/system/fleet -n auto --dist loadfile --quiet --durations=5

test-package: ## what is installed: the package's life in a virtual machine, image and archive built, the wheel
	@scripts/setup --system
	@scripts/setup --package
	$(PYTEST) tests/package --quiet --durations=15

wheel: setup ## the wheel of this architecture, for pipx: dist/rosrv_appliance-VERSION-….whl, and the versions that were tested
	$(BIN)/python -m hatchling build --target wheel
	$(MAKE) --silent --no-print-directory constraints > dist/rosrv_appliance-$$($(BIN)/python -c 'import appliance; print(appliance.__version__)')-constraints.txt

# pip also installs the two packages that requirements.lock leaves out.
constraints:
	@{ cat requirements.lock; grep -E '^(numpy|apsw)==' requirements-dev.lock; } | sed -n 's/^\([a-z0-9.-]*==[^ ]*\) .*/\1/p'

package: setup ## the Debian package of this machine's architecture, or of ARCH="amd64 arm64": dist/rosrv_VERSION_ARCH.deb
	@scripts/setup --package
	$(BIN)/python -m distribution.deb $(or $(ARCH),$$(dpkg --print-architecture))

image: setup ## the container image and the list of its parts: dist/rosrv-image_VERSION_ARCH.tar, .cdx.json
	$(BIN)/python -m distribution.image $(ARGS)

site: setup ## all that a site without a network needs, in one archive: dist/rosrv-site_VERSION_ARCH.tar
	$(BIN)/python -m distribution.site $(ARGS)

fleet: setup ## the collector: its images dist/rosrv-fleet-images_VERSION_ARCH.tar, its wheel dist/rosrv_fleet-VERSION-….whl
	mkdir -p dist
	cd fleet && ../$(BIN)/python -m hatchling build --target wheel --directory ../dist
	docker build --file fleet/Dockerfile --target postgres --tag rosrv/fleet-postgres $(ARGS) .
	docker build --file fleet/Dockerfile --target collector --tag rosrv/fleet $(ARGS) .
	docker save --output dist/rosrv-fleet-images_$$($(BIN)/python -c 'import appliance; print(appliance.__version__)')_$$(dpkg --print-architecture).tar rosrv/fleet rosrv/fleet-postgres

release: ## everything anew, with provenance and checksums that KEY=FILE signs
	rm -rf dist
	$(MAKE) wheel package site fleet ARCH="amd64 arm64"
	$(BIN)/python -m distribution.release "$(KEY)"

bench: setup ## measure: every program in benchmarks/
	@for program in benchmarks/*.py; do echo "== $$program"; $(BIN)/python -m "benchmarks.$$(basename "$$program" .py)"; done

prove: ## check what is proved: the proofs in Coq, the code of events, the models of the insertion and the lease, their mutants and traces (docs/dev/assurance.md)
	@scripts/setup --proofs
	$(PYTEST) tests/proofs -n auto --dist loadfile --quiet --durations=5

clean: ## remove what was built, .venv included
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	rm -f appliance/relay/transport/*.abi3.so
