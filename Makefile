# `make run`, `make test` and `make lint` each set up .venv from nothing where it is missing or older than what it is made from.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.PHONY: help run label docs test test-all test-mujoco lint format bench bench-gpu venv rendering browser wheel clean

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
OUT ?= out
# MuJoCo's newest release and no Meta-World, which takes 3.3.0 alone.
NEWEST := .venv-mujoco
# Two test processes of one thread each use two cores fully; more threads only wait for one another.
THREADS := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
# Either takes half of the files in their order, so that what a file's tests share is made once.
PYTEST := -m pytest -n 2 --dist worksteal

help:
	@echo "make run         meta-train a model, adapt it from ten preferences, show the result (files in $(OUT)/)"
	@echo "make label       the page on which a person answers, on this machine"
	@echo "make docs        the documentation, in docs/_build/html/"
	@echo "make test        the default test suite"
	@echo "make test-all    the default suite and the slow tests"
	@echo "make test-mujoco the MuJoCo families' tests on MuJoCo's newest release, in $(NEWEST)"
	@echo "make lint        ruff, mypy and import-linter"
	@echo "make format      let ruff format the code"
	@echo "make bench       the benchmarks of speed and memory; tables go to benchmarks/results/speed/"
	@echo "make bench-gpu   the same of what runs on a CUDA device"
	@echo "make venv        only set up $(VENV)"
	@echo "make wheel       build the distribution in dist/"
	@echo "make clean       remove what was built, and $(VENV)"

run: $(STAMP) rendering
	$(BIN)/python -m sb3_poem.demo --out $(OUT)

label: $(STAMP) rendering
	$(BIN)/python -m sb3_poem label

# Tutorials are executed, which takes minutes; DOCS_ARGS="-D nb_execution_mode=off" leaves that out.
docs: $(STAMP) rendering
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[docs]'
	$(THREADS) $(BIN)/python -m sphinx -W --keep-going -q -b html $(DOCS_ARGS) docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

test: $(STAMP) rendering browser
	$(THREADS) $(BIN)/python $(PYTEST) $(PYTEST_ARGS)

test-all: $(STAMP) rendering browser
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[ray]'
	$(THREADS) $(BIN)/python $(PYTEST) -m "not gpu" $(PYTEST_ARGS)

test-mujoco: rendering
	test -x $(NEWEST)/bin/python || $(PYTHON) -m venv $(NEWEST)
	grep -v '^mujoco==' constraints.txt >$(NEWEST)/constraints.txt
	$(NEWEST)/bin/python -m pip install --quiet -c $(NEWEST)/constraints.txt torch
	$(NEWEST)/bin/python -m pip install --quiet -c $(NEWEST)/constraints.txt -e '.[dev,label]'
	$(NEWEST)/bin/python -m pip install --quiet --upgrade mujoco
	$(THREADS) $(NEWEST)/bin/python $(PYTEST) -m "not slow and not gpu and not metaworld" \
		tests/poem_envs tests/test_family_contract.py tests/common/test_vec_env.py \
		tests/pearl_sac/test_collection.py tests/poem_sac/test_external_families.py $(PYTEST_ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	PYTHONPATH=envs:. $(BIN)/lint-imports

bench: $(STAMP)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[bench]'
	for script in benchmarks/bench_*.py; do $(THREADS) $(BIN)/python "$$script"; done

# In the paper's own sizes.
bench-gpu: $(STAMP)
	$(BIN)/python -m pytest -m gpu $(PYTEST_ARGS)
	$(BIN)/python benchmarks/bench_gradient_step.py --device cuda --threads 2

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

venv: $(STAMP)

# torch comes first and alone, so that nothing else decides which of its builds is installed.
$(STAMP): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "sb3_poem needs Python 3.11 or newer; name one with make PYTHON=..." >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt torch
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev,label,metaworld]'
	@touch $@

# MuJoCo draws off screen through EGL or OSMesa. Nothing else needs either, so their absence is no error.
rendering:
	@if ! ldconfig -p 2>/dev/null | grep -qE 'lib(EGL|OSMesa)\.so'; then \
		if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null \
			&& apt-get update -qq && apt-get install -y -qq --no-install-recommends libegl1 libgl1 >/dev/null; then \
			echo "Installed libegl1 and libgl1 for off-screen rendering."; \
		else \
			echo "Videos need off-screen OpenGL, which is missing here: apt-get install libegl1 libgl1 (or libosmesa6)." >&2; \
		fi; \
	fi

# The tests of the page drive Chromium; where it cannot be had they are skipped, and say so.
browser:
	@if ! command -v chromium >/dev/null && ! command -v chromium-browser >/dev/null; then \
		if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null \
			&& apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium >/dev/null; then \
			echo "Installed chromium for the tests of the page."; \
		else \
			echo "The tests of the page need chromium and are skipped: apt-get install chromium." >&2; \
		fi; \
	fi

wheel: $(STAMP)
	$(BIN)/python -m build --outdir dist .

clean:
	rm -rf $(VENV) $(NEWEST) build dist *.egg-info .import_linter_cache .mypy_cache .pytest_cache .ruff_cache .hypothesis
