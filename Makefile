# The developer's commands. `make` alone lists the targets.

PYTHON ?= python3
BIN := .venv/bin
OPEN3D_LIBRARIES := libegl1 libgl1 libx11-6 libusb-1.0-0
SCREENS := chromium chromium-driver mesa-vulkan-drivers
PIP_INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check
LOCKED := --no-deps --require-hashes -r requirements.lock
# uv does not read the configuration of pip.
UV_INSTALL = index=$${PIP_INDEX_URL:-$$($(BIN)/pip config get global.index-url 2>/dev/null)}; $(PIP_INSTALL) uv \
    && $(BIN)/uv pip install --quiet --python $(BIN)/python $${index:+--default-index "$$index"} $(LOCKED)
DEMO := demo
MUTATIONS := nice -n 19 $(BIN)/python -m tests.mutations
# Two test processes use both cores, so their libraries must not start threads. The many processes that
# they start read the bytecode of the first, also in containers, most of which forbid writing it.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q \
    -n 2 --dist loadfile --no-loadscope-reorder

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all mutations coverage screens kernels fixtures picture odd faults lint format \
    bench model parts lock clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

setup: .venv/ready ## make the virtual environment .venv from the lock file

.venv/ready: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	    || { echo "shapecat needs Python 3.11 or newer: make PYTHON=python3.12 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || $(call apt,python3-venv)
	$(PYTHON) -m venv .venv
	@echo "installing the locked packages, 2.5 GB: half a minute with uv, two minutes without it"
	@$(UV_INSTALL) || { echo "uv failed, so pip installs the packages"; $(PIP_INSTALL) --no-compile $(LOCKED); }
	@$(PIP_INSTALL) --no-deps --editable .
	@# pip would compile on a single core, and also what a run never loads
	@$(BIN)/python -m compileall -qq -j 0 -x '/(tests?|ray|plotly|dash)/' .venv/lib || true
	@$(BIN)/python -c 'import open3d' >/dev/null 2>&1 || $(call apt,$(OPEN3D_LIBRARIES)) \
	    || echo "(only training on triangle meshes needs them)" >&2
	@touch $@

demo: setup ## simulate a recording, process it, and print where the results are
	$(BIN)/shapecat simulate $(DEMO)/tabletop.mcap --scene tabletop --frames 60 --seed 3 --color --overwrite
	$(BIN)/shapecat process $(DEMO)/tabletop.mcap --out $(DEMO)/out --overwrite

test: setup kernels ## run the quick tests
	@{ command -v chromedriver && ls /usr/share/vulkan/icd.d/*; } >/dev/null 2>&1 \
	    || echo "(browser and screenshot tests are skipped; \`make screens\` installs what they need)" >&2
	$(PYTEST) -m 'not many'

test-all: setup kernels ## run all tests, including long ones, and a sample of mutants
	$(PYTEST)
	$(MUTATIONS) --only quick --count 60 --least 0.65

mutations: setup kernels ## flip every operator in the modules without kernels (takes hours)
	$(MUTATIONS)

coverage: setup kernels ## run the quick tests and print the lines and branches that they reach
	$(PYTEST) -m 'not many' --cov --cov-report=term:skip-covered

screens: ## install the packages that browser and screenshot tests need
	@{ command -v chromedriver && ls /usr/share/vulkan/icd.d/*; } >/dev/null 2>&1 || $(call apt,$(SCREENS))

kernels: setup ## compile the kernels beforehand (about a minute)
	@$(BIN)/python -m shapecat.rehearsal

fixtures: setup kernels ## remake the recordings in fixtures/ and their expected tables
	$(BIN)/python -m tests.fixtures

picture: setup ## redraw the picture in ARCHITECTURE.md from the imports of the code
	$(BIN)/python -m tests.picture

odd: setup ## process damaged and unusual recordings and print the outcome of each
	$(BIN)/python -m tests.odd

faults: setup kernels ## interrupt, kill and starve the command at random and print the outcomes
	$(BIN)/python -m tests.faults --count 200 --minutes 13

lint: setup ## check style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/codespell shapecat cli schemas tests benchmarks docs *.md

format: setup ## format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix-only .

bench: setup ## measure stages and whole recordings, and print tables
	$(BIN)/python -m benchmarks
	$(BIN)/python -m benchmarks.whole
	$(BIN)/python -m benchmarks.cluster

model: setup ## train the default model on the simulator
	$(BIN)/python -m shapecat.models.training

parts: setup ## grow the trees of detection: for merging segments, then for rejecting background
	$(BIN)/python -m shapecat.models.parts
	$(BIN)/python -m shapecat.models.structure

lock: setup ## update requirements.lock from pyproject.toml
	$(BIN)/pip install --quiet uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --group dev --generate-hashes \
	    --no-emit-index-url --no-header pyproject.toml --output-file requirements.lock

clean: ## remove the environment and all build products
	rm -rf .venv build dist $(DEMO) *.egg-info

# Install Debian packages as root; otherwise print the command for it.
apt = { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null \
    && apt-get update -qq && apt-get install -y -qq --no-install-recommends $(1) >/dev/null; } \
    || { echo "missing system packages: sudo apt-get install -y $(1)" >&2; false; }
