# make train   set up .venv, train two PSM arms to reach, then evaluate     (ARGS="--seed 1")
# make test    set up .venv, run the tests                                  (ARGS="-k cli")
# make docs    set up .venv, write the site of the documentation into site/ (open site/index.html)
# make gallery set up .venv, draw docs/gallery.md and its pictures again     (ARGS="--only psm reach")
# make audit   known weaknesses and licences of all dependencies; skipped, and said so, where no service answers
# make release build the wheel, try it in a new environment, list what it brings (SBOM): dist/
# make matrix  tests with other versions of Python and of dependencies       (ARGS="--python 3.13")
# make lock    constraints.hashes.txt, the hashes of all that constraints.txt names
# make coverage  lines of the package that the tests run, module by module  (ARGS="-k cli")
# make mutants   change the package in places, and count what tests notice   (ARGS="--area rewards --sample 50")
# make lint    style       make typecheck    types       make clean    remove what was built

PYTHON ?= $(firstword $(shell command -v python3.11 python3 python))
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SITE_READY := $(VENV)/.ready-for-docs
SUPPLY_READY := $(VENV)/.ready-for-supply
QUALITY_READY := $(VENV)/.ready-for-quality
# On Linux without an NVIDIA driver, PyTorch's build for CPUs: the one of PyPI brings gigabytes of CUDA libraries.
CPU_TORCH := $(if $(filter Linux,$(shell uname -s)),$(if $(shell command -v nvidia-smi),,yes))
ARGS ?=
FULL_DISK := test_a_full_disk_is_one_sentence_and_the_run_goes_on_when_there_is_room

.DEFAULT_GOAL := help
.PHONY: help train test docs gallery audit release matrix lock coverage mutants lint typecheck clean

help:
	@sed -n 's/^# make/make/p' Makefile

train: $(READY)
	$(BIN)/surgical-marl train reach --scene bimanual_psm $(ARGS)

# Neighbours in a file share what they compile: a worker takes half of the tests, in order, and from the other when done.
test: $(READY)
	$(BIN)/pytest -n 2 --dist worksteal --durations 20 $(ARGS)

# Not --quiet: it would also hide the warnings that --strict counts.
docs: $(SITE_READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

gallery: $(READY)
	$(BIN)/python -m docs.studies.gallery --results docs $(ARGS)

audit: $(SUPPLY_READY)
	@$(BIN)/python .ci/audit.py $(ARGS)

release: $(SUPPLY_READY)
	$(BIN)/python .ci/release.py

matrix: $(SUPPLY_READY)
	$(BIN)/python .ci/matrix.py $(ARGS)

# For all platforms, by the index that uv uses; 3.11.5 is the oldest Python that all of the pinned versions take.
lock: $(SUPPLY_READY)
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11.5 --no-deps --no-annotate --generate-hashes \
	  --custom-compile-command "make lock" --default-index https://pypi.org/simple \
	  --output-file constraints.hashes.txt constraints.txt

# Not a part of `make test`, and slower. One process at a time, because what a worker of pytest-xdist had run was lost once;
# processes that tests start are counted too. Coverage can't write to a full disk, so the tests of that are left out.
coverage: export COVERAGE_FILE := $(CURDIR)/build/coverage/data
coverage: $(QUALITY_READY)
	rm -rf build/coverage && mkdir -p build/coverage
	-$(BIN)/coverage run -m pytest --deselect tests/project/test_reliability.py::$(FULL_DISK) $(ARGS)
	-$(BIN)/coverage combine --quiet
	$(BIN)/coverage report | tee build/coverage/report.txt

mutants: $(QUALITY_READY)
	$(BIN)/python .ci/mutants.py $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

typecheck: $(READY)
	$(BIN)/mypy

clean:
	rm -rf $(VENV) build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp is newer than what defines the environment, so a second call starts at once.
$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "surgical-marl: no Python found, install Python 3.11 or newer" >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo \
	  "surgical-marl: $$($(PYTHON) --version) is too old, name Python 3.11 or newer: make PYTHON=python3.11" >&2; exit 2; }
	@echo "surgical-marl: setting up $(VENV), once; pip takes some minutes and says nothing" >&2
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@test -z "$(CPU_TORCH)" || $(BIN)/python -m pip install --no-input --quiet --progress-bar off --retries 1 --no-deps \
	  -c constraints.txt --index-url https://download.pytorch.org/whl/cpu torch || echo \
	  "surgical-marl: no PyTorch for CPUs at download.pytorch.org, taking the one of PyPI" >&2
	$(BIN)/python -m pip install --no-input --quiet --progress-bar off -c constraints.txt -e '.[test]'
	@touch $@

# What the site is made of, which nothing else needs.
$(SITE_READY): $(READY)
	$(BIN)/python -m pip install --no-input --quiet --progress-bar off -c constraints.txt -e '.[docs]'
	@touch $@

# What looks after the dependencies, likewise.
$(SUPPLY_READY): $(READY)
	$(BIN)/python -m pip install --no-input --quiet --progress-bar off -c constraints.txt -e '.[supply]'
	@touch $@

# Of cosmic-ray only what makes mutants: it brings a server and reports, which are not used, and a library under the LGPL.
$(QUALITY_READY): $(READY)
	$(BIN)/python -m pip install --no-input --quiet --progress-bar off -c constraints.txt coverage
	$(BIN)/python -m pip install --no-input --quiet --progress-bar off -c constraints.txt --no-deps cosmic-ray parso stevedore
	@touch $@
