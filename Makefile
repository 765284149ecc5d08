# make repro: the bundled scene, end to end.  make test: every check.  Both set the environment up first.
SHELL := /bin/bash
.ONESHELL:
.SHELLFLAGS := -eu -o pipefail -c
PYTHON ?= $(shell command -v python3.11 || command -v python3 || echo python3)
PY := .venv/bin/python
export PATH := $(CURDIR)/.venv/bin:$(PATH)
export SCENEEXPANDER_ROOT := $(CURDIR)
export MLFLOW_DISABLE_TELEMETRY := true
export MLFLOW_SERVER_ENABLE_JOB_EXECUTION := false
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Where no bytecode is wanted beside the sources it goes here: hundreds of interpreters start, and to compile torch costs each of them seconds.
ifdef PYTHONDONTWRITEBYTECODE
unexport PYTHONDONTWRITEBYTECODE
export PYTHONPYCACHEPREFIX ?= $(CURDIR)/.cache/bytecode
endif

.PHONY: repro test test-unit test-conformance test-pipeline test-slow lint setup ui view expand ablation mini-scores clean help

help: ## What there is
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

repro: .venv/.stamp ## Run the pipeline on the scenes in params.yaml
	$(PY) -m stages.check
	$(PY) -m sceneexpander.pipeline.repro
	@echo "report: $(CURDIR)/outputs/report/index.html"

setup: .venv/.stamp ## Make .venv from requirements.lock

# The lock is installed as it is; the package itself without dependencies (it builds an optional extension, from KERNEL).
KERNEL := $(addprefix src/sceneexpander/splatting/kernel/,rasteriser.cpp recipe.py)
.venv/.stamp: requirements.lock requirements-nodeps.lock pyproject.toml setup.py $(KERNEL)
	@test -x $(PY) || "$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo 'error: PYTHON: "$(PYTHON)" is not Python 3.11 or newer; make PYTHON=/path/to/python3.11' >&2; exit 2; }
	test -x $(PY) || "$(PYTHON)" -m venv .venv
	$(PY) -m pip install --quiet --no-compile -r requirements.lock
	$(PY) -m pip install --quiet --no-compile --no-deps -r requirements-nodeps.lock
	$(PY) -m pip install --quiet --no-compile --no-deps --no-build-isolation -e .
	touch $@

test: lint test-unit test-conformance test-pipeline ## Style, types, unit and conformance tests, the pipeline end to end

lint: .venv/.stamp ## Style and types
	ruff check .
	ruff format --check .
	mypy

test-unit: .venv/.stamp
	OMP_NUM_THREADS=1 pytest tests/unit -n 2 --dist worksteal -m "not slow"

test-conformance: .venv/.stamp
	pytest tests/conformance

test-pipeline: .venv/.stamp
	OMP_NUM_THREADS=1 pytest tests/pipeline -n 2 --dist loadfile -m "not slow"

test-slow: .venv/.stamp ## What `make test` leaves out for its length: lenses, many places, the long parts of the GPU check
	OMP_NUM_THREADS=1 pytest tests/unit tests/pipeline -n 2 --dist worksteal -m slow

ui: .venv/.stamp ## Runs in the browser (loopback only)
	exec $(PY) -m sceneexpander ui

# make view SCENE=courtyard ROUND=1
view: SCENE ?= courtyard
view: ROUND ?= 1
view: .venv/.stamp ## Walk through a scene in the browser (loopback only): SCENE=, ROUND=, ARGS=
	exec $(PY) -m sceneexpander view "outputs/$(SCENE)" --round "$(ROUND)" $(ARGS)

# make expand PHOTOS=folder INSERTED=picture.png PROMPT="Behind the table is a bench."
# The values reach the shell as environment variables, so quotes in a sentence need no escaping.
export PHOTOS INSERTED PROMPT NAME
expand: .venv/.stamp ## Expand your own photos: PHOTOS=, INSERTED=, PROMPT=, NAME=, ARGS=
	@test -n "$$PHOTOS" || { echo 'error: PHOTOS: is missing; make expand PHOTOS=folder INSERTED=picture PROMPT="..."' >&2; exit 2; }
	exec $(PY) -m sceneexpander expand "$$PHOTOS" $(if $(INSERTED),--inserted "$$INSERTED") $(if $(PROMPT),--prompt "$$PROMPT") $(if $(NAME),--name "$$NAME") $(ARGS)

ablation: .venv/.stamp ## The rows of the paper's ablation table, controls and more, against known truth: ARGS=
	exec $(PY) -m sceneexpander ablation $(ARGS)

mini-scores: .venv/.stamp ## Errors of the embedded reconstructor on made scenes
	$(PY) scripts/mini_scores.py

clean: ## Remove outputs and caches of tools (keeps .venv, the pipeline's cache, mlflow and runs)
	rm -rf outputs .pytest_cache .mypy_cache .ruff_cache .hypothesis build
	find src stages tests -name __pycache__ -type d -prune -exec rm -rf {} +
