# Every target sets up what it needs in .venv. Another interpreter: make PYTHON=python3.12 TARGET
PYTHON ?= $(shell python3.11 -c '' 2>/dev/null && echo python3.11 || echo python3)
WORKERS ?= 2
BIN := .venv/bin

# XLA partitions its work by the number of cores; one core each keeps results the same bits everywhere.
export NPROC = 1

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1|/p' Makefile | awk -F'|' '{printf "make %-12s%s\n", $$1, $$2}'

quickstart: .venv/.ready  ## fit a prior on the shipped logs, train PPO and PPO-DAP, compare them
	$(BIN)/ppo-dap quickstart

test: lint  ## lint, then run every test
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

lint: .venv/.ready  ## style, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

sample: .venv/.ready  ## make the shipped Hopper logs again and print their hash: 300k steps of PPO, then 40k rows of it
	$(BIN)/ppo-dap train --task Hopper-v5 --method ppo --steps 300000 --seed 100 --out runs/hopper-behaviour --quiet
	$(BIN)/ppo-dap collect runs/hopper-behaviour --steps 40000 --out src/ppo_dap/logs/samples/hopper-medium.npz

bench-peers: .venv/.ready .venv-peers/.ready  ## the benchmark with five other PPOs, in an environment of their own
	$(BIN)/ppo-dap bench --peers .venv-peers/bin/python --json bench.json

.venv-peers/.ready: benchmarks/peers/requirements.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --disable-pip-version-check --quiet -r benchmarks/peers/requirements.txt
	@touch $@

lock:  ## resolve pyproject.toml into constraints.txt; UPGRADE=--upgrade moves to the newest versions
	$(PYTHON) -m venv --clear .venv/lock
	.venv/lock/bin/python -m pip install --disable-pip-version-check --quiet uv
	.venv/lock/bin/uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 \
		--fork-strategy fewest --generate-hashes --no-emit-index-url --no-annotate --no-header \
		$(UPGRADE) --quiet --output-file constraints.txt >/dev/null

.venv/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || { \
		echo "ppo-dap needs Python 3.11, 3.12 or 3.13; '$(PYTHON)' is $$($(PYTHON) --version 2>&1)." >&2; \
		echo "Install one of them, or name it: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)" >&2; \
		exit 1; }
	@echo "Setting up .venv with $(PYTHON): one to three minutes"
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --require-hashes -r constraints.txt
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation -e .
	@touch $@

.PHONY: help quickstart test lint sample bench-peers lock
