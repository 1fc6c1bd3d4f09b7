# One entrance for people and for continuous integration; `make` alone lists the targets.
# Everything happens in .venv, which is made on first use and renewed when the requirements change.

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
MAKEFLAGS += --no-print-directory

# Packages are installed without byte code; each is compiled once, by the first process that imports it.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
BIN := $(VENV)/bin
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))

# The first interpreter on PATH that runs and is new enough; `make PYTHON=...` overrules it.
CANDIDATES := python3.11 python3.12 python3.13 python3.14 python3 python
PYTHON ?= $(shell for p in $(CANDIDATES); do \
	$$p -c "$(NEW_ENOUGH)" 2>/dev/null && echo $$p && break; done)

.PHONY: help demo test lint typecheck check nightly format bench results docs clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' Makefile

demo: $(VENV)/.with-run ## Run four methods on a robot that changes; draw and film them
	@echo "A robot drives along a track. After the second target its motors drive it backwards, until"
	@echo "three targets are left."
	@echo "Four methods meet that: the old physics alone (physics), an ensemble that learns from every"
	@echo "step (online_pe), the old physics behind AFM (afm_physics), and an oracle that knows it."
	@$(BIN)/afm-rl hydra.run.dir=outputs/demo overwrite=true budget=400 video=gif
	@awk -F, 'NR == 1 { for (k = 1; k <= NF; k++) at[$$k] = k } NR > 1 { who[$$at["finished"]] = \
		who[$$at["finished"]] " " $$at["method"] } END { print "All targets were reached by:" \
		who["True"] "; not by:" who["False"] "." }' outputs/demo/missions.csv
	@echo "Look at outputs/demo/figures/trajectory.png: paths are black while the robot is healthy, orange"
	@echo "while its motors are reversed; and at the film outputs/demo/video/all_methods.gif"

# Tests have three tiers: no marker (make test), `check` (make check) and `slow` (make nightly).
PYTEST := CI=true OMP_NUM_THREADS=1 MPLBACKEND=Agg $(BIN)/pytest -q -n 2 --dist worksteal \
	--durations=10 --nbmake tests notebooks
TIER := not check and not slow
MINUTES := 4
COVERED := --cov --cov-report=term-missing:skip-covered --cov-fail-under=95

test: $(VENV)/.with-test ## Run the tests of what contributors change most, in about 4 minutes
	@echo "running the tests; they take about $(MINUTES) minutes on two idle cores"
	@$(PYTEST) -m "$(TIER)" $(if $(COVER),$(COVERED))

lint: $(VENV)/.with-test ## Check style, format and spelling
	@$(BIN)/ruff check --quiet . && $(BIN)/ruff format --quiet --check . && $(BIN)/codespell
	@echo "lint: clean"

# Tools that read sources follow folders, not the map that turns envs/ into afm_rl.envs. They get a
# copy laid out as the wheel is; tests/test_packaging.py keeps the wheel itself true to the sources.
.PHONY: build/package
build/package:
	@rm -rf $@ && mkdir -p $@ && cp -R afm_rl $@ && cp -R envs conf $@/afm_rl

typecheck: $(VENV)/.with-test build/package ## Check types
	@cd build/package && $(CURDIR)/$(BIN)/mypy --config-file $(CURDIR)/pyproject.toml \
		--cache-dir $(CURDIR)/.mypy_cache --package afm_rl
	@cd benchmarks/suites && MYPYPATH=$(CURDIR)/build/package $(CURDIR)/$(BIN)/mypy \
		--config-file $(CURDIR)/pyproject.toml --cache-dir $(CURDIR)/.mypy_cache \
		$(patsubst benchmarks/suites/%/__init__.py,--package %,$(wildcard benchmarks/suites/*/__init__.py))

check: TIER := not slow
check: MINUTES := 12
check: COVER := 1
check: lint typecheck test ## What every merge must pass: lint, types, two tiers of tests, coverage

nightly: $(VENV)/.with-test build/try/robots.js ## Run the slow tests; write benchmarks/results/nightly.json
	@echo "running the slow tests; they take about 25 minutes on two idle cores"
	@mkdir -p build; $(PYTEST) -m slow --junitxml=build/nightly.xml; status=$$?; \
		$(BIN)/python benchmarks/nightly.py build/nightly.xml && exit $$status

format: $(VENV)/.with-test ## Put the code in shape, and what options say into the comments of conf
	@$(BIN)/ruff check --quiet --fix-only . && $(BIN)/ruff format .
	@$(BIN)/python -m afm_rl.cli.settings
	@$(BIN)/python docs/theme/arguments.py

bench: $(VENV)/.with-run ## Run every benchmarks/bench_*.py, one after the other
	@for f in $(sort $(wildcard benchmarks/bench_*.py)); do \
		echo "== $$f"; OMP_NUM_THREADS=1 MPLBACKEND=Agg $(BIN)/python $$f || exit 1; done

results: $(VENV)/.with-test ## List measured results with their age; NAME=policies measures one again
	@$(BIN)/python benchmarks/results.py $(NAME)

# A page of the site simulates robots. Where it cannot be had, the site is built without.
TRY := $(addprefix build/try/,mujoco-mujoco-3.14.0.tgz onnxruntime-web-1.30.0.tgz three-0.187.0.tgz)
GRAPHS := $(foreach room,compiling correction dynamics,$(wildcard afm_rl/$(room)/*.* afm_rl/$(room)/*/*.*))

PACKAGE = $(subst mujoco-mujoco-,@mujoco/mujoco@,$(subst web-,web@,$(subst three-,three@,$*)))

build/try/%.tgz:
	@mkdir -p $(@D) && cd $(@D) && npm pack --silent $(PACKAGE) > /dev/null || true

build/try/robots.js: $(VENV)/.with-docs $(TRY) $(GRAPHS) docs/theme/browser.py
	@$(BIN)/python docs/theme/browser.py || true

TRY_PAGE := build/try/robots.js

docs: $(VENV)/.with-docs build/package $(TRY_PAGE) ## Build the documentation into site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict && echo "docs: site/index.html"

clean: ## Remove build products and caches; .venv and outputs/ stay
	@rm -rf build dist site *.egg-info .coverage .coverage.* htmlcov .hypothesis \
		.pytest_cache .mypy_cache .ruff_cache
	@find afm_rl envs conf tests -name __pycache__ -prune -exec rm -rf {} +

$(BIN)/python:
	@"$(PYTHON)" -c "$(NEW_ENOUGH)" 2>/dev/null || { \
		echo "afm-rl needs Python 3.11 or newer: put one on PATH or name it, make PYTHON=..." >&2; \
		exit 1; }
	@echo "making $(VENV) with $(PYTHON)"
	@"$(PYTHON)" -m venv $(VENV)

# .with-X holds the package and its extra X.
$(VENV)/.with-%: pyproject.toml setup.py constraints.txt | $(BIN)/python
	@echo "installing afm-rl ($*) into $(VENV); the first time takes some minutes"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile \
		-c constraints.txt -e ".[$*]"
	@touch $@
