# Everything a new machine needs: `make demo`, `make test`. Only Python 3.11 and make are taken for granted.
PYTHON ?= python3.11
IS_PYTHON := $(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null
NO_PYTHON := echo 'Python 3.11 was not found as "$(PYTHON)". Install it (Debian: apt-get install python3.11-venv; uv: \
uv python install 3.11), or say where yours is: make PYTHON=/path/to/python3.11' >&2; exit 1
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SERVES := $(VENV)/.serves
export SKILLS_SAMPLE_RECORDINGS ?= $(abspath $(wildcard ../shared/recordings))
# Compiled once: a process that compiles all of ours for itself takes three times as long to start.
export PYTHONDONTWRITEBYTECODE :=
export SKILLS_PAPER_DATA ?= $(abspath $(wildcard ../shared/paper/data))
export SKILLS_TEST_JIGSAWS ?= $(abspath $(wildcard ../shared/jigsaws))
export SKILLS_TEST_BENCHMARKS ?= $(abspath $(wildcard ../shared/benchmarks))
export SKILLS_TEST_CASES ?= $(abspath $(wildcard ../shared/cases))

.PHONY: demo test serve docs bench faults nightly mutants deep lint lock wheelhouse wheel-check clean

# uv where it is present, venv and pip otherwise; either way the same versions, checked by their hashes. One package,
# movement-primitives, comes as source: setuptools is there first, and it is built before Cython, a need of python-fcl, is
# installed, so with no compiler.
SETUPTOOLS := sed -n '/^setuptools==/,/[^\\]$$/p' requirements.lock

# `make demo WHEELHOUSE=build/wheelhouse` takes everything from that folder, and asks no network.
ifdef WHEELHOUSE
export PIP_NO_INDEX := 1
export UV_OFFLINE := 1
export PIP_FIND_LINKS := $(abspath $(WHEELHOUSE))
export UV_FIND_LINKS := $(abspath $(WHEELHOUSE))
endif

# Installs a lock into `.venv`: $(1) the lock, $(2) how uv does it, $(3) what it is for. Installers say nothing while they
# unpack, so every few seconds there is a word on how much has arrived. Nothing of ours opens the models of PyBullet.
define install
	@command -v uv >/dev/null 2>&1 || $(IS_PYTHON) || { $(NO_PYTHON); }
	@echo "Installing $(3) into $(VENV): $$(grep -c '^[a-z].*==' $(1)) packages, once. It takes a minute or more."
	@while sleep 4; do echo "  $$(du -sm $(VENV) 2>/dev/null | cut -f1) MB so far"; done & saying=$$!; trap 'kill $$saying' EXIT; \
	if command -v uv >/dev/null 2>&1; then \
	  { uv venv -q --allow-existing --python $(PYTHON) $(VENV) || { $(NO_PYTHON); }; } && \
	  $(SETUPTOOLS) | VIRTUAL_ENV=$(CURDIR)/$(VENV) uv pip install -q --require-hashes -r - && \
	  VIRTUAL_ENV=$(CURDIR)/$(VENV) uv pip $(firstword $(2)) -q --compile-bytecode --require-hashes --no-build-isolation $(wordlist 2,2,$(2)) $(1) && \
	  VIRTUAL_ENV=$(CURDIR)/$(VENV) uv pip install -q --no-deps --no-build-isolation -e . ; \
	else \
	  { $(IS_PYTHON) || { $(NO_PYTHON); }; } && \
	  $(PYTHON) -m venv $(VENV) && \
	  $(SETUPTOOLS) | $(BIN)/python -m pip install -q --require-hashes -r /dev/stdin && \
	  $(BIN)/python -m pip install -q --require-hashes --no-build-isolation -r $(1) && \
	  $(BIN)/python -m pip install -q --no-deps --no-build-isolation -e . ; \
	fi
	@rm -rf $(VENV)/lib/python*/site-packages/pybullet_data
	@touch $(SERVES)
endef

$(SERVES): requirements-serve.lock pyproject.toml
	$(call install,requirements-serve.lock,install -r,what serving needs)

$(READY): requirements.lock requirements-serve.lock pyproject.toml
	$(call install,requirements.lock,sync,what serving and testing need)
	@touch $@

demo: $(READY)
	@$(BIN)/python -m skills.demo

# Types are checked beside the tests, which wait for processes now and then: a fifth of two processors is idle.
test: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy > $(VENV)/types.txt 2>&1 & types=$$!; trap 'kill $$types 2>/dev/null' INT TERM; \
	$(BIN)/python -m pytest; tests=$$?; \
	wait $$types; types=$$?; cat $(VENV)/types.txt; \
	[ $$tests -eq 0 ] && [ $$types -eq 0 ]

serve: $(SERVES)
	@$(BIN)/skills serve --samples

# The documentation site into build/site: a dead link fails. The builder goes into the same `.venv`; the rest asks no network.
docs: $(READY)
	@if command -v uv >/dev/null 2>&1; then \
	  VIRTUAL_ENV=$(CURDIR)/$(VENV) uv pip install -q --no-deps --require-hashes -r requirements-docs.lock ; \
	else \
	  $(BIN)/python -m pip install -q --no-deps --require-hashes -r requirements-docs.lock ; \
	fi
	@$(BIN)/python docs/make_site.py
	@$(BIN)/zensical build --strict --clean
	@echo "The site: build/site/index.html; its search needs a server: $(BIN)/python -m http.server -b 127.0.0.1 -d build/site"

bench: $(READY)
	@$(BIN)/python -m tests.bench $(PARTS)

# The real service with failing disks, clocks and processes; `make faults FAULTS="full-disk clock-forward"` for some.
faults: $(READY)
	@$(BIN)/python -m tests.faults $(FAULTS)

# The documentation site, the sweeps, and ten runs of the suite in a row: none red, nothing left behind.
nightly: docs
	@$(BIN)/python -m pytest --hypothesis-profile=nightly -m nightly
	@for run in 1 2 3 4 5 6 7 8 9 10; do $(BIN)/python -m pytest --hypothesis-profile=nightly || exit 1; done

# Small changes of the code that guards, each of which a test must notice; about half an hour. CONTRIBUTING.md says more.
mutants: $(READY)
	@$(BIN)/python -m tests.mutants

lint: $(READY)
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .
	@$(BIN)/mypy

# The learners beyond the table, into the same `.venv`. torch has builds of one version with other hashes, so it is taken by
# its version alone, and which build it is, is the installer's setting (CONTRIBUTING.md); all else is checked by hashes.
TORCH := $(shell sed -n 's/.*"\(torch==[^"]*\)".*/\1/p' pyproject.toml)
deep: $(READY)
	@if command -v uv >/dev/null 2>&1; then \
	  VIRTUAL_ENV=$(CURDIR)/$(VENV) uv pip install -q --no-deps --require-hashes --no-build-isolation -r requirements-deep.lock && \
	  VIRTUAL_ENV=$(CURDIR)/$(VENV) uv pip install -q $(TORCH) ; \
	else \
	  $(BIN)/python -m pip install -q --no-deps --require-hashes --no-build-isolation -r requirements-deep.lock && \
	  $(BIN)/python -m pip install -q $(TORCH) ; \
	fi

# The locks hold versions and hashes, no addresses. That of `serve` is a part of the first one, which tests need; `deep` adds
# the extra, but for torch and what a build of it for graphics cards brings along, `docs` the builder of the site. Needs uv.
HOW := --python-version 3.11 --universal --generate-hashes --no-header --no-annotate -q
LOCK := uv pip compile pyproject.toml $(HOW)
OF_TORCH := /^(torch|triton|cuda-[a-z]+|nvidia-[a-z0-9-]+)==/,/[^\\]$$/d
lock:
	$(LOCK) --extra pictures --group dev -o requirements.lock
	$(LOCK) --extra pictures --group build -c requirements.lock -o requirements-serve.lock
	@mkdir -p build
	$(LOCK) --extra deep -c requirements.lock -o build/deep.lock
	sed -E '$(OF_TORCH)' build/deep.lock > requirements-deep.lock
	uv pip compile --group docs $(HOW) -c requirements.lock -o requirements-docs.lock

# What `requirements.lock` names, for this platform, into build/wheelhouse; what comes as source stays source, so that the
# hashes of the lock hold there too. With pip, for uv downloads nothing.
wheelhouse:
	@$(IS_PYTHON) || { $(NO_PYTHON); }
	@$(PYTHON) -m venv build/pip
	@$(SETUPTOOLS) | build/pip/bin/python -m pip install -q --require-hashes -r /dev/stdin
	@for lock in requirements.lock requirements-docs.lock; do \
	  build/pip/bin/python -m pip download -q --no-deps --no-build-isolation --require-hashes -d build/wheelhouse -r $$lock || exit 1; \
	done

# The wheel in bare environments of each Python, without a compiler; the packages come from pip's index.
PYTHONS ?= $(PYTHON)
wheel-check:
	@sh tests/wheel.sh $(PYTHONS)

clean:
	rm -rf $(VENV) build .cache
