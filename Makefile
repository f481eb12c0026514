# The README's two commands are `make train` and `make test`; every target installs what it needs into .venv first.
# Another interpreter: make PYTHON=python3.12 test. Fewer tests: make test PYTEST_ARGS="-k monitor -x".

PYTHON ?= python3
PYTEST_ARGS ?=
# A shorter training: make train TRAIN_ARGS="--game-steps 50000".
TRAIN_ARGS ?=
# Test processes. Tests run torch with one thread each.
JOBS ?= 2

VENV = .venv
RUN = $(VENV)/bin/python -m
# Without setuptools' box on editable installations, which looks like an error.
INSTALL = $(VENV)/bin/python -W ignore::UserWarning -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
# What training needs, and everything: linters, Sphinx, Ray, notebooks, ...
TRAINING = $(VENV)/.training
INSTALLED = $(VENV)/.installed

# Many processes are started: they keep compiled modules, whatever the environment says, and pip leaves compiling to them,
# since all of torch takes longer than the rest of the installation.
export PYTHONDONTWRITEBYTECODE =

.PHONY: help install train test coverage bench docs notebooks teams check format-check lint types format clean distclean

help: ## this list (the default)
	@echo "make TARGET, with TARGET one of"
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1\t\2/p' Makefile | expand -t 16

train: $(TRAINING) ## train SAF on TeamSupport, compare it with a random team, leave model, curve and GIF
	@$(RUN) sb3_saf.quickstart $(TRAIN_ARGS)

test: $(INSTALLED) ## run the tests
	@$(RUN) pytest -n $(JOBS) --dist loadscope --no-loadscope-reorder $(PYTEST_ARGS)

check: $(INSTALLED) ## what CI runs: format, lint, types, documentation, notebooks, tests
	@$(MAKE) --no-print-directory --output-sync -j $(JOBS) notebooks format-check lint types docs
	@$(MAKE) --no-print-directory test

coverage: $(INSTALLED) ## run the tests and print their branch coverage
	@$(RUN) pytest -n $(JOBS) --dist loadscope --cov sb3_saf --cov hecogrid_envs --cov-branch --cov-report term:skip-covered $(PYTEST_ARGS)

bench: $(INSTALLED) ## measure speed beside another gridworld; writes benchmarks/results.md
	@$(RUN) benchmarks.environments

docs: $(INSTALLED) ## build the documentation into build/docs/html, warnings as errors
	@echo "== documentation"
	@$(RUN) sphinx -b html -W --keep-going -n -q docs build/docs/html

notebooks: $(INSTALLED) ## run the notebooks with small numbers; whole: .venv/bin/python -m notebooks.execute --full
	@echo "== notebooks"
	@$(RUN) notebooks.execute --jobs $(JOBS)

teams: $(INSTALLED) ## play the teams of trained_teams/ again and compare with the rows of their tables
	@$(RUN) sb3_saf.experiments teams

format-check: $(INSTALLED)
	@echo "== format"
	@$(RUN) ruff format --check . || { echo "The files above are not formatted: run 'make format'." >&2; exit 1; }

lint: $(INSTALLED) ## ruff's rules (pyproject.toml), and no room imports a room above it (setup.cfg)
	@echo "== lint"
	@$(RUN) ruff check .
	@$(VENV)/bin/lint-imports --no-cache --no-logo

types: $(INSTALLED) ## mypy over everything (setup.cfg)
	@echo "== types"
	@$(RUN) mypy

format: $(INSTALLED) ## format the code and repair what ruff can repair
	@$(RUN) ruff check --fix-only --quiet .
	@$(RUN) ruff format .

install: $(INSTALLED) ## only set up .venv, with all that tests, documentation and notebooks need
	@echo "to go on: source $(VENV)/bin/activate"

# Repeated when one of these files changes; an interrupted installation leaves no stamp and is continued.
$(TRAINING): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	    echo "'$(PYTHON)' is not Python 3.10 or newer. Name one that is: make PYTHON=python3.12 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || { \
	    echo "'$(PYTHON)' cannot make virtual environments. On Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	@echo "== install what training needs into $(VENV) (about a minute the first time)"
	@$(PYTHON) -m venv $(VENV)
	@$(INSTALL) --upgrade pip
	@$(INSTALL) --editable '.[render]'
	@touch $@

$(INSTALLED): $(TRAINING)
	@echo "== install the rest into $(VENV): tests, types, documentation, notebooks, Ray, games of others"
	@$(INSTALL) --editable '.[dev,docs,export,lbf,mpe,notebooks,ray,render,rware,sisl,zoo]'
	@touch $@

clean: ## remove caches and what was built
	rm -rf build dist *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -path ./$(VENV) -prune -o -type d -name __pycache__ -exec rm -rf {} +

distclean: clean ## also remove .venv
	rm -rf $(VENV)
