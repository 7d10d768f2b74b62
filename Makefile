# The commands of this project; `make` alone lists them. All of them work in .venv, which the first one makes.
#   make test PYTHON=python3.12    with that Python, where .venv is not there yet

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# One process a core, a file at a time each: files share what they compile.
PYTEST := $(BIN)/python -m pytest -q -n auto --dist loadfile

.DEFAULT_GOAL := help
.PHONY: help run test test-all lint format bench sb3 torture experiments docs clean

help: ## list the commands
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "make %-11s %s\n", $$1, $$2 }' Makefile

run: $(INSTALLED) ## learn an objective, train PPO with it, judge it: runs/quick/report.html
	@$(BIN)/lpo run --preset quick $(if $(wildcard runs/quick/config.json),--resume,--out) runs/quick

test: $(INSTALLED) ## the tests, without the slow ones
	@$(PYTEST)

# Measuring coverage makes JAX's tracing, and with it the tests, 1.4 times as slow.
test-all: $(INSTALLED) ## all tests, the slow ones too, and their coverage
	@$(PYTEST) --cov --cov-report=term --cov-fail-under=90 -m "slow or not slow"

lint: $(INSTALLED) ## style, format and types; changes nothing
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy

format: $(INSTALLED) ## put every file into the project's format
	@$(BIN)/ruff check --fix-only
	@$(BIN)/ruff format

bench: $(INSTALLED) .venv-rejax/.installed ## train agents in the bandits beside rejax's: time and return
	@$(BIN)/python -m experiments benchmark --rejax-python .venv-rejax/bin/python

sb3: $(INSTALLED) .venv-sb3/.installed ## train Stable-Baselines3's agents in the bandits and in Gymnasium: docs/sb3.md
	@$(BIN)/python -m experiments sb3 --python .venv-sb3/bin/python --executor local

torture: $(INSTALLED) ## kill runs at random moments, damage files at random: docs/reliability.md
	@$(BIN)/python -m experiments reliability

experiments: $(INSTALLED) ## the paper's experiments: measure what is missing (quick presets), write docs/experiments.md
	@$(BIN)/python -m experiments --preset quick

docs: $(INSTALLED) .venv-docs/.installed ## the documentation's site, in site/; its pages as pictures in site/screenshots where Chromium is
	@$(BIN)/scb explain Synthetic-Pendulum-v1 --html --out docs/interactive/Synthetic-Pendulum-v1
	@$(BIN)/lpo show lpo-pendulum --html --out docs/interactive/lpo-pendulum
	@.venv-docs/bin/jupyter nbconvert --log-level=WARN --execute --to markdown --output-dir docs/notebooks notebooks/*.ipynb
	@.venv-docs/bin/zensical build --strict --clean
	@$(BIN)/python -m tests.site

# What is only for a comparison or the site is apart: rejax needs a gymnax that this project doesn't run on, and
# PyTorch is large.
REJAX := rejax==0.1.3 gymnax==0.0.9
SB3 := -c constraints.txt -e . stable-baselines3==2.9.2 torch==2.15.0
DOCS := -c constraints.txt -e . zensical==0.0.73 mkdocstrings==1.0.8 mkdocstrings-python==2.0.11 \
  nbconvert==7.17.2 ipykernel==7.4.0

.venv-rejax/.installed: PACKAGES := $(REJAX)
.venv-sb3/.installed: PACKAGES := $(SB3)
.venv-docs/.installed: PACKAGES := $(DOCS)
.venv-rejax/.installed .venv-sb3/.installed .venv-docs/.installed: $(INSTALLED)
	@echo "Installing $(filter-out -% . constraints.txt,$(PACKAGES)) into $(@D) ..."
	@$(PYTHON) -m venv --clear $(@D)
	@$(@D)/bin/python -m pip --disable-pip-version-check --quiet install $(PACKAGES)
	@touch $@

clean: ## remove caches and build outputs; .venv and runs stay
	@rm -rf build dist site docs/interactive docs/notebooks htmlcov coverage.xml .coverage .coverage.* *.egg-info
	@rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache
	@find . -path ./$(VENV) -prune -o -path ./.git -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

# An existing .venv is kept if its Python and pip still start. setuptools goes in first, so that
# building the package uses the tested version and not whatever is newest that day.
$(INSTALLED): pyproject.toml constraints.txt
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { \
	  command -v $(PYTHON) >/dev/null || { \
	    echo "make: found no $(PYTHON): install Python 3.11 or newer, or name one with PYTHON=/path/to/python3." >&2; exit 1; }; \
	  $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "make: $(PYTHON) is $$($(PYTHON) -V 2>&1), this project needs Python 3.11 or newer: name one with PYTHON=python3.12, say." >&2; exit 1; }; \
	  echo "Making $(VENV) with $$($(PYTHON) -V) ..."; \
	  $(PYTHON) -m venv --clear $(VENV) || { \
	    rm -rf $(VENV); echo "make: $(PYTHON) could not make $(VENV): install its venv module (python3-venv on Debian and Ubuntu)." >&2; exit 1; }; }
	@$(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "make: $(VENV) holds $$($(BIN)/python -V 2>&1), this project needs Python 3.11 or newer: remove $(VENV) and try again." >&2; exit 1; }
	@echo "Installing what the project needs into $(VENV) (a few minutes the first time) ..."
	@$(PIP) install -c constraints.txt setuptools
	@$(PIP) install -c constraints.txt --no-build-isolation -e '.[dev]'
	@touch $@
