# Each target works as the first command after cloning: what it needs is installed on the way.
# Another interpreter: make test PYTHON=python3.12

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.installed
READY_DEV := .venv/.installed-dev
READY_DOCS := .venv/.installed-docs
READY_REFEREE := .venv/.installed-referee
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check
# tests as pytest rewrites them are kept, whatever the shell says: collecting them again takes a third
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test slow long mutants lint docs referee reproduce clean

help:
	@echo "make setup   create .venv and install the package with its extras and development tools"
	@echo "make demo    simulate two machines, write pages to drive three; results in demo-output/"
	@echo "make test    fast tests"
	@echo "make slow    slow tests: browser, MuJoCo, long simulations"
	@echo "make long    more of the same for an hour, before a release"
	@echo "make mutants   100 random faults in the code, and which of them fast tests notice; an hour"
	@echo "make lint    ruff and mypy"
	@echo "make docs    the site, its tutorials executed and its links followed; build/site/index.html"
	@echo "make referee   speed, and all engines on all problems: 40 minutes; docs/performance.md"
	@echo "make reproduce   both forwarder papers again; docs/validation/"
	@echo "make clean   remove .venv, caches and results"

setup: $(READY_DEV)

$(READY): pyproject.toml
	@$(PYTHON) -c "" 2>/dev/null || \
	    { echo "error: no $(PYTHON) on this machine, install Python 3.11 to 3.14 or name it: make PYTHON=/path/to/python" >&2; exit 2; }
	@$(PYTHON) -c "import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))" || \
	    { echo "error: $$($(PYTHON) --version) is too old or too new, take 3.11 to 3.14: make PYTHON=python3.12" >&2; exit 2; }
	@$(PYTHON) -c "import venv, ensurepip" 2>/dev/null || \
	    { echo "error: $(PYTHON) has no venv module, install it: sudo apt install python3-venv (Debian, Ubuntu)" >&2; exit 2; }
	@echo "Installing the package and what it needs into .venv: 0.4 GB of downloads, one to five minutes"
	@$(PYTHON) -m venv .venv
	@$(INSTALL) --editable .
	@touch $@

$(READY_DEV): $(READY)
	@echo "Installing the development tools into .venv: 0.3 GB of downloads, one to five minutes"
	@$(INSTALL) --editable '.[dev]'
	@touch $@

$(READY_DOCS): $(READY)
	@echo "Installing what builds the site into .venv: 0.2 GB of downloads, one to five minutes"
	@$(INSTALL) --editable '.[docs]'
	@touch $@

$(READY_REFEREE): $(READY)
	@echo "Installing the engines of benchmarks/ into .venv: 0.5 GB of downloads, one to five minutes"
	@$(INSTALL) --editable '.[referee]'
	@touch $@

demo: $(READY)
	$(BIN)/crane demo --out demo-output --force

test: $(READY_DEV)
	$(BIN)/python -m pytest -n 2 --dist worksteal

# a third process works where browsers and programs are waited for
slow: $(READY_DEV)
	$(BIN)/python -m pytest -n 3 --dist worksteal -m "slow and not long"

long: $(READY_DEV)
	$(BIN)/python -m pytest -n 2 --dist worksteal -m long

# faults and the start of the random numbers: make mutants N=20 SEED=2
N ?= 100
SEED ?= 1
mutants: $(READY_DEV)
	$(BIN)/python scripts/mutants.py --number $(N) --seed $(SEED)

lint: $(READY_DEV)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy

docs: $(READY_DOCS)
	rm -rf build/site
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/site
	$(BIN)/linkchecker --no-status build/site/index.html

referee: $(READY_REFEREE)
	$(BIN)/python benchmarks --write docs/performance.md

reproduce: $(READY)
	$(BIN)/python scripts/reproduce_mini_forwarder.py --write docs/validation/mini_forwarder.md
	$(BIN)/python scripts/reproduce_hydraulic_forwarder.py --write docs/validation/hydraulic_forwarder.md

clean:
	rm -rf .venv .hypothesis .mypy_cache .pytest_cache .ruff_cache build dist demo-output docs/generated
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
