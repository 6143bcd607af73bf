# Two commands: `make demo` (needs no torch) and `make test`. Each sets up what it needs in .venv, once.
PYTHON ?= python3
VENV := .venv
PEERS := .venv-peers
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
ARGS ?=
# What `make test` installs: every extra but `peers`, which only benchmarks.peers needs.
EXTRAS := server game training sweep locomotion telemetry fuzz dev

.PHONY: demo test lint bench bench-peers lock clean
.DELETE_ON_ERROR:

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# The run-time rooms and the game: what a game programmer needs.
$(VENV)/runtime: requirements/runtime.lock pyproject.toml | $(BIN)/python
	$(PIP) -r requirements/runtime.lock
	$(PIP) --no-deps --editable .
	touch $@

# Training and development on top. torch comes first, alone and at its one version, so that pip takes the CPU build
# where one is offered.
$(VENV)/all: requirements/all.lock $(VENV)/runtime
	$(PIP) torch==2.13.0
	$(PIP) -r requirements/all.lock
	touch $@

demo: $(VENV)/runtime
	@$(BIN)/python -m game.play $(ARGS)

test: lint
	$(BIN)/python -m pytest -n 2 $(ARGS)

lint: $(VENV)/all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Others' Decision Transformers, in a venv of their own: d3rlpy pins a gymnasium that is older than the game's.
$(PEERS)/ready: requirements/peers.lock pyproject.toml
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check torch==2.13.0
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check -r requirements/peers.lock
	touch $@

bench-peers: $(PEERS)/ready
	$(PEERS)/bin/python -m benchmarks.peers $(ARGS)

bench: $(VENV)/all
	$(BIN)/python -m benchmarks.latency $(ARGS)
	$(BIN)/python -m benchmarks.budget $(ARGS)
	$(BIN)/python -m benchmarks.density $(ARGS)
	$(BIN)/python -m benchmarks.net_benefit $(ARGS)

# Exact versions of everything, for both set-ups. The CPU build's local version label is taken off torch.
lock: $(VENV)/all
	$(PIP) pip-tools
	$(BIN)/pip-compile -q --upgrade --strip-extras --no-annotate --no-header --no-emit-index-url --no-emit-find-links \
		pyproject.toml --extra server --extra game -o requirements/runtime.lock
	$(BIN)/pip-compile -q --upgrade --strip-extras --no-annotate --no-header --no-emit-index-url --no-emit-find-links \
		pyproject.toml $(foreach extra,$(EXTRAS),--extra $(extra)) -c requirements/runtime.lock -o requirements/all.lock
	$(BIN)/pip-compile -q --upgrade --strip-extras --no-annotate --no-header --no-emit-index-url --no-emit-find-links \
		pyproject.toml --extra server --extra peers -o requirements/peers.lock
	sed -i 's/^\(torch==[0-9.]*\)+.*/\1/' requirements/all.lock requirements/peers.lock

clean:
	rm -rf $(VENV) $(PEERS) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis out
