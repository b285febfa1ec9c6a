# Two commands do everything from a fresh clone: `make attack` and `make test`. `make help` lists the rest.

PYTHON ?= python3
# On Linux pip by itself takes torch's CUDA build, gigabytes that are of no use here. PyTorch's "Get started" page names
# an index of CPU wheels (200 MB): make TORCH_INDEX=ITS-ADDRESS setup. TORCH_INDEX=none silences the advice.
TORCH_INDEX ?=
ARGS ?=
# Tests that run side by side; most of them keep one processor busy.
JOBS ?= 2

# The tests start many processes, and each would compile the package again.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.set-up
SOURCES := advsearch scenes tests benchmarks docs tools

export TORCH_INDEX

.DEFAULT_GOAL := help
.PHONY: help setup attack test test-core test-all test-slow test-zoo fuzz check lint format typecheck docs bench study reference wheel check-wheel check-channels docs-versions clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(STAMP) ## make .venv with everything pinned, and see to a libLLVM that works

$(STAMP): constraints.txt setup.cfg pyproject.toml tools/setup.sh
	@bash tools/setup.sh "$(PYTHON)" "$(VENV)"
	@touch $@

attack: $(STAMP) ## search the worst texture for a mug; more flags through ARGS="--epsilon 0.05"
	@$(BIN)/advsearch attack --object mug --control texture $(ARGS)

test: $(STAMP) ## run the quick tests and the smallest whole commands, in four minutes; ARGS="-k name" picks some
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow and not docs and not medium" $(ARGS)

test-core: $(STAMP) ## run the quick tests while all islands are hidden, or those of WITHOUT="control", or one: WITHOUT=advsearch.questions.harden
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow and not docs and not medium" \
	  --without-islands "$(or $(WITHOUT),all)" $(ARGS)

test-all: $(STAMP) ## run all tests but the slow ones
	@bash tools/browser.sh
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(ARGS)

test-slow: $(STAMP) ## run the tests that take minutes; ARGS="--one-in 10" runs a tenth, others every day
	@$(BIN)/python -m pytest -m slow $(ARGS)

test-zoo: $(STAMP) ## run the tests of torchvision's, timm's and transformers' networks with these, in build/zoo
	@bash tools/test_zoo.sh $(BIN)/python build/zoo $(ARGS)

fuzz: $(STAMP) ## load 400 hostile files and run folders, each in bounds of time and memory; ARGS="--seed 1" makes others
	@PYTHONPATH=tests $(BIN)/python -m fuzz $(ARGS)

check: lint typecheck test-all docs ## everything that has to pass before a commit

lint: $(STAMP) ## look for mistakes, for code that is not formatted for pages that are not true of the code and for bundled files that the scripts in scenes/ do not make
	@$(BIN)/ruff check $(SOURCES)
	@$(BIN)/ruff format --check --quiet $(SOURCES) || { echo "not formatted: run make format"; exit 1; }
	@$(BIN)/python tools/check_docs.py
	@$(BIN)/python tools/check_names.py
	@$(BIN)/python tools/check_sentences.py
	@$(BIN)/python scenes/build.py --check

format: $(STAMP) ## format the code and mend what can be mended
	@$(BIN)/ruff format $(SOURCES)
	@$(BIN)/ruff check --fix $(SOURCES)

typecheck: $(STAMP) ## mypy, strict
	@$(BIN)/mypy

docs: $(STAMP) ## run what the pages say and build them into build/site; fails on a broken link
	@$(BIN)/python -m pytest -q -n $(JOBS) -m docs
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --no-build-isolation -c constraints.txt -e '.[docs]'
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# what compares results and not times, and takes long
STUDIES := searches closed_form policies precision kill harden sequential verdict_flow verdicts drives

bench: $(STAMP) ## the benchmarks: ratios against a floor measured in the same run
	@set -e; for file in $(filter-out $(STUDIES:%=benchmarks/%.py) benchmarks/golden.py,$(wildcard benchmarks/[!_]*.py)); do \
	  echo "== $$file"; $(BIN)/python $$file $(ARGS); done

study: $(STAMP) ## the slow studies: policies at equal renders, stated budgets, promised errors, kills (over an hour)
	@set -e; for name in $(STUDIES); do echo "== $$name"; $(BIN)/python benchmarks/$$name.py $(ARGS); done

reference: $(STAMP) ## render, train and evaluate the bundled classifier again (some 45 minutes)
	@$(BIN)/python tools/reference_model.py all $(ARGS)

wheel: $(STAMP) ## build the wheel into dist/, with a list of what it was built and tested with (SBOM)
	@rm -rf build/lib  # modules that have gone since the last build
	@$(BIN)/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .
	@$(BIN)/python tools/sbom.py dist
	@ls -l dist/*.whl

check-wheel: $(STAMP) ## build the wheel, install it in a new environment and use it from another folder
	@bash tools/check_wheel.sh "$(VENV)"

check-channels: $(STAMP) ## check wheel, Dockerfile and conda recipe by twine, hadolint and rattler-build; says which are missing
	@bash tools/check_channels.sh "$(VENV)"

docs-versions: $(STAMP) ## build the pages of every tag and of this commit into build/versions
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --no-build-isolation -c constraints.txt -e '.[docs]'
	@PATH="$(abspath $(BIN)):$$PATH" bash tools/docs_versions.sh

clean: ## remove .venv, caches and what was built; runs/ stays
	rm -rf $(VENV) build dist *.egg-info .cache .hypothesis .pytest_cache .mypy_cache .ruff_cache
	find $(SOURCES) -name __pycache__ -prune -exec rm -rf {} +
