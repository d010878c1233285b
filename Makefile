# Each target makes the environment it needs; a fresh machine with Python 3.11+ is enough.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PEERS := .venv-peers
DOCS := .venv-docs
WHEEL := .venv-wheel
MINIMAL := .venv-minimal
PYTHONS ?= python3.11 python3.12 python3.13

.DEFAULT_GOAL := help
.PHONY: help hil demo test test-slow test-live lint format bench bench-accuracy figures figures-check figures-all peers nightly mutants hazards docs docs-site trials lock \
  minimal wheel-test test-pythons clean

help:
	@echo "make demo     replay a bundled trial into a simulated stimulator and write its report"
	@echo "make test     style, types and tests"
	@echo "make test-slow  the tests that take longer"
	@echo "make test-live  live sessions and simulated devices as processes, against their deadlines"
	@echo "make wheel-test  the built wheel in an empty environment, outside the checkout: demo, simulate, analyse, hil"
	@echo "make minimal  a live session in an environment without any extra: how large that is, and how quick"
	@echo "make test-pythons  demo and quick tests under each of PYTHONS ($(PYTHONS)) that this machine has"
	@echo "make lint     style and types only"
	@echo "make bench    one table of speed, beside other libraries and the bare arithmetic (about 10 minutes)"
	@echo "make bench-accuracy  one table of accuracy, ours and other libraries' on the same recordings (about 5 minutes)"
	@echo "make figures  render the figures of docs/ from benchmarks/results/ and the program's constants"
	@echo "make figures-check  measure the quick ones again; an error if one has moved or a page is out of date"
	@echo "make figures-all  measure all of them again, and render"
	@echo "make hil      the whole fault campaign on every transport of this machine; takes hours"
	@echo "make docs     regenerate the generated parts of docs/"
	@echo "make docs-site  the documentation as a site, notebooks run, links checked, off-line: out/site/index.html (about 2 minutes)"
	@echo "make trials   regenerate sim_inputs/ from its seeds"
	@echo "make nightly  the tests that take long: fuzzing, many examples"
	@echo "make mutants  mutation testing of the gate and the plan; an unexplained survivor is an error (about 20 minutes)"
	@echo "make hazards  takes each hazard's control out of a copy and sees its test fail (about 5 minutes)"

$(VENV)/run.stamp: locks/run.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "fes needs Python 3.11 or newer; set PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r locks/run.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	$(BIN)/python -m compileall -q fes drivers statemachine
	-$(BIN)/fes compile
	touch $@

$(VENV)/dev.stamp: locks/dev.lock $(VENV)/run.stamp
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r locks/dev.lock
	touch $@

demo: $(VENV)/run.stamp
	$(BIN)/fes demo

# What anybody's machine must pass, whatever else runs on it.
test: lint
	$(BIN)/python -m pytest -n 2 -m "not slow and not live"

test-slow: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -n 2 -m "slow and not live"

# Deadlines between processes, one test at a time; prints what it measured.
test-live: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -rA -m live

# PYTHONPATH is cleared: the checkout must not be found.
wheel-test: $(VENV)/run.stamp
	rm -rf $(WHEEL) dist
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation --wheel-dir dist .
	$(PYTHON) -m venv $(WHEEL)
	$(WHEEL)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r locks/run.lock
	$(WHEEL)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-index dist/*.whl
	folder=$$(mktemp -d) && cd $$folder && export PYTHONPATH= PATH="$(abspath $(WHEEL))/bin:$$PATH" && \
	  fes demo && fes simulate --seconds 40 && fes analyse out/simulated.parquet && fes hil --only imu_frozen && \
	  cd / && rm -rf $$folder

# The devices around the session run in the usual environment.
minimal: $(VENV)/dev.stamp
	rm -rf $(MINIMAL)
	$(PYTHON) -m venv $(MINIMAL)
	$(MINIMAL)/bin/python -m pip install --quiet --disable-pip-version-check .
	PYTHONPATH= $(BIN)/python benchmarks/speed/live_latency.py --python $(MINIMAL)/bin/python \
	  --json benchmarks/results/speed-live-minimal.json

# A Python that this machine has not is named and passed over; each has an environment and an output folder of its own.
test-pythons:
	worst=0; for python in $(PYTHONS); do \
	  $$python -c pass 2>/dev/null || { echo "$$python: not on this machine, passed over"; continue; }; \
	  name=$$(basename $$python); echo "$$name:"; \
	  $(MAKE) VENV=.venv-$$name PYTHON=$$python .venv-$$name/dev.stamp && \
	  .venv-$$name/bin/fes demo --out out/$$name && \
	  .venv-$$name/bin/python -m pytest -n 2 --ignore=tests/transports -m "not slow" || worst=$$?; \
	done; exit $$worst

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/dev.stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/dev.stamp $(PEERS)/peers.stamp
	$(BIN)/python benchmarks/speed/speed_table.py --peers $(PEERS)/bin/python --keep; $(BIN)/python benchmarks/lib/figures.py

bench-accuracy: $(VENV)/dev.stamp $(PEERS)/peers.stamp
	$(BIN)/python benchmarks/accuracy/accuracy_table.py --peers $(PEERS)/bin/python

# What a page says of figures is rendered from benchmarks/results/; benchmarks/lib/figures.py says how.
figures: $(VENV)/dev.stamp
	$(BIN)/python benchmarks/lib/figures.py

figures-check: $(VENV)/dev.stamp
	$(BIN)/python benchmarks/lib/figures.py --check

figures-all: $(VENV)/dev.stamp $(PEERS)/peers.stamp
	$(BIN)/python benchmarks/lib/figures.py --all

# The libraries we compare with: an environment of their own, never part of the product.
peers: $(PEERS)/peers.stamp

$(PEERS)/peers.stamp: locks/peers.lock
	test -x $(PEERS)/bin/python || $(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r locks/peers.lock
	touch $@

nightly: $(VENV)/dev.stamp
	FES_EXAMPLES=nightly $(BIN)/python -m pytest -m "slow or not slow"

# In scratch copies: the checkout is not touched, except for docs/mutants.md.
mutants: $(VENV)/dev.stamp
	$(BIN)/python tests/mutation/mutants.py --write

hazards: $(VENV)/dev.stamp
	$(BIN)/python tests/safety/hazard_mutants.py

docs: $(VENV)/dev.stamp
	$(BIN)/python docs/phases_page.py
	$(BIN)/python docs/architecture_page.py
	$(BIN)/python tests/safety/documents.py --write

# The tools are an environment of their own. A warning is an error, a link that leads nowhere is a warning.
docs-site: $(DOCS)/docs.stamp
	PYTHONPATH="$(CURDIR)" $(DOCS)/bin/python -m sphinx -q -W --keep-going -b html -c docs/site docs out/site
	@echo "out/site/index.html"

$(DOCS)/docs.stamp: locks/docs.lock locks/run.lock
	test -x $(DOCS)/bin/python || $(PYTHON) -m venv $(DOCS)
	$(DOCS)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r locks/run.lock -r locks/docs.lock
	touch $@

# Every fault on every transport, then kill -9 100 times on each and 1,000,000 random frames; some hours. A transport
# that this machine has not is named and passed over.
HIL_TRANSPORTS ?= udp_multicast slcan serial serial_rehastim2 socketcan
hil: $(VENV)/run.stamp
	worst=0; for transport in $(HIL_TRANSPORTS); do \
	  for what in "" "--only controller_killed --repeat 100"; do \
	    $(BIN)/fes hil --transport $$transport $$what; code=$$?; \
	    test $$code -eq 0 -o $$code -eq 2 || worst=$$code; \
	  done; \
	done; \
	$(BIN)/fes hil --only random_frames --repeat 16 || worst=$$?; \
	$(BIN)/python benchmarks/safety/hil_table.py out/hil-*/hil.json --json benchmarks/results/hil.json && \
	  $(BIN)/python benchmarks/lib/figures.py; exit $$worst

trials: $(VENV)/run.stamp
	$(BIN)/fes trials sim_inputs

# Needs uv on the path; writes no address of any registry.
lock:
	uv pip compile pyproject.toml --extra analysis --extra live --extra cohort --extra build --universal --python-version 3.11 --generate-hashes --no-annotate --no-header --no-strip-extras -o locks/run.lock
	uv pip compile pyproject.toml --extra dev -c locks/run.lock --universal --python-version 3.11 --generate-hashes --no-annotate --no-header --no-strip-extras -o locks/dev.lock
	uv pip compile benchmarks/peers/requirements.in --universal --python-version 3.11 --generate-hashes --no-annotate --no-header --no-strip-extras -o locks/peers.lock
	uv pip compile docs/site/requirements.in -c locks/dev.lock --universal --python-version 3.11 --generate-hashes --no-annotate --no-header --no-strip-extras -o locks/docs.lock

clean:
	rm -rf $(VENV) $(VENV)-* out dist
