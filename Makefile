# `make help` lists the targets. Two commands on a fresh machine: `make demo` and `make test`.
# Every target installs what it needs first (scripts/setup; quick when there is nothing to do).

SHELL := /bin/bash
# What pytest makes of a test file once, it need not make again for each worker and each run.
unexport PYTHONDONTWRITEBYTECODE
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
BIN := .venv/bin
PYTEST := $(BIN)/pytest
CHECKED := conftest.py appliance roswire rosmop stubs fleet tests examples benchmarks distribution lab
PRODUCTS := appliance rosmop fleet lab
DETERMINISTIC := -c pyproject.toml --rootdir=. -m "not nightly and not real" tests/unit tests/world rosmop/tests fleet/tests lab/tests

.PHONY: help setup demo check static unit test units real $(PRODUCTS:%=test-%) smoke nightly lane steady pages mutants prove wheel constraints package image site fleet release bench clean

help: ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 24

setup: ## install what is missing to develop: Debian packages and .venv
	@scripts/setup

demo: ## the appliance at work: a simulated robot, its operator and an attacker, in three to five minutes
	@scripts/setup --run
	@$(BIN)/rosrv demo $(ARGS)

check: setup ## format, lint, types, dependency directions, rules on the source, quick unit tests: a minute
	$(MAKE) --jobs=2 --output-sync=target static unit

static:
	$(BIN)/ruff format --check $(CHECKED)
	$(BIN)/ruff check $(CHECKED)
	$(BIN)/mypy
	$(BIN)/lint-imports

unit:
	$(PYTEST) $(DETERMINISTIC) --quick -n $$(nproc) --quiet

test: setup ## check, all tests that chance cannot fail, and at most 100 cases with real nodes (root: network namespaces)
	$(MAKE) --jobs=3 --output-sync=target static units real

test-appliance: setup ## of the gate, only the tests of the appliance; test-rosmop, test-fleet, test-lab: of that product
	$(MAKE) --jobs=2 --output-sync=target units real ONLY=appliance

$(filter-out test-appliance,$(PRODUCTS:%=test-%)): setup
	$(MAKE) units ONLY=$(@:test-%=%)

# The real cases wait half of their time: what computes has the processors then, and after them, for it is nice.
units:
	nice $(BIN)/python -m tests.gate $(or $(ONLY),$(PRODUCTS))

real:
	$(BIN)/python -m tests.gate real

smoke: setup ## the container as a user starts it: built, a denied call, a policy reload, an audit search
	@scripts/setup --containers
	$(PYTEST) tests/smoke --quiet

nightly: setup ## the lanes of the night that are not green at this commit: attacks, crashes, takeovers, containers, browser; WORDS=standby,lease
	$(if $(LANE)$(FROM),$(error LANE is now WORDS, as in make nightly WORDS=$(or $(LANE),standby); FROM is gone: make nightly leaves out lanes that are green))
	$(BIN)/python -m tests.nightly $(if $(WORDS),--words $(WORDS))

lane: setup ## one lane of the night: NAME=nodes; without NAME it lists the lanes of tests/lanes.toml
	@$(BIN)/python -m tests.nightly --lane $(or $(NAME),names)

steady: setup ## run one test N times beside busy loops: make steady TEST=tests/integration/test_nodes.py N=50
	$(BIN)/python -m tests.steady $(TEST) $(N)

pages: setup ## write the generated pages: settings, commands, events, metrics, quotas, evidence about guards
	$(BIN)/python -m distribution.generated_pages

mutants: setup ## change the kernel, or the modules of a MODULE, in N small wrong ways (SEED=1), and list what no test of the gate finds
	$(BIN)/python -m tests.mutants --number $(or $(N),200) --seed $(or $(SEED),1) $(if $(MODULE),--module $(MODULE))

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

release: ## everything anew, with provenance and checksums that KEY=FILE signs; DESPITE="reason" if a lane of the night is not green
	mkdir -p build && $(BIN)/python -m tests.nightly --release --despite "$(DESPITE)" > build/lanes.txt
	$(BIN)/python -m distribution.released_presets --check
	rm -rf dist
	$(MAKE) wheel package site fleet ARCH="amd64 arm64"
	cp build/lanes.txt dist/
	$(BIN)/python -m distribution.release "$(KEY)"

bench: setup ## measure: every program in benchmarks/
	@for program in benchmarks/*.py; do echo "== $$program"; $(BIN)/python -m "benchmarks.$$(basename "$$program" .py)"; done

prove: ## check what is proved: the proofs in Coq, the code of events, the models of the insertion and the lease, their mutants and traces (docs/dev/assurance.md)
	@scripts/setup --proofs
	$(PYTEST) lab/tests/proofs -n auto --dist loadfile --quiet --durations=5

clean: ## remove what was built, .venv included
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	rm -f appliance/relay/transport/*.abi3.so
