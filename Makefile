# What there is to do here. Everything runs in a virtual environment of its own, .venv, made when it is needed first:
#   make install  the environment alone, for its commands; tests and documentation add what they need
#   make lock     versions of all packages, chosen anew: constraints.txt
#   make demo     draw a small survey, process it, compare the cloud with the true bed
#   make test     style and types, then all tests, with the examples in docstrings and documentation
#   make check    style alone: what ruff finds
#   make types    what the type checker finds (mypy)
#   make format   let ruff mend what it can
#   make bench    the benchmarks of minutes, on what they draw themselves: tables and figures of the documentation
#   make tables   tables of the documentation, written anew from benchmarks/results
#   make stress   one thing after another made worse on a small drawn survey: where it degrades, and whether it says so
#   make soak     damaged files of every kind (a minute of processor time; SECONDS=3600 for more): a value or a sentence;
#                 runs that are killed (KILLS=9; each costs half a run): the same cloud
#   make docs     the documentation as a site, its notebooks run: build/site/docs/index.html
#   make licences the licence of everything that it needs; fails at one that does not fit Apache-2.0
#   make clean    remove the demo and what tools left; make distclean: the environment too
# PYTHON=python3.12 chooses the interpreter; otherwise the first of 3.11 to 3.14 that is found.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
# What the program needs, with the extras that its commands use; what the tests need; what the documentation needs.
READY := $(VENV)/ready
READY_TEST := $(VENV)/ready-test
READY_DOCS := $(VENV)/ready-docs
DEMO := .demo/survey
RUN := $(DEMO)/bathynerf
# Those that need neither survey data nor hours; each file says at its head how it is run.
BENCHMARKS := optics sweep compare
# Of this the small size, some eight minutes of an idle core: errors of all models over time.
FIELDS := error_time
TRUTH := $(DEMO)/truth
BOUNDS = $$($(BIN)/python -c 'import tomllib; print(*tomllib.load(open("$(DEMO)/survey.toml", "rb"))["area"]["bounds"])')

OLDEST_PYTHON := $(shell sed -nE 's/^requires-python = ">=([0-9.]+),.*/\1/p' pyproject.toml)

# An environment that was moved or copied with its folder is set up again: its paths are those of the old place.
ifneq ($(shell cat $(READY) 2>/dev/null),$(CURDIR))
.PHONY: $(READY)
endif

.PHONY: help install lock demo test check types format bench tables stress soak docs licences clean distclean

help:
	@sed -n '2,/^$$/s/^# \{0,1\}//p' Makefile

install: $(READY)

$(READY): EXTRAS = gltf,heic,vector,viewer,dxf,cluster
$(READY_TEST): EXTRAS = test
$(READY_DOCS): EXTRAS = docs
$(READY_TEST) $(READY_DOCS): $(READY)
$(READY) $(READY_TEST) $(READY_DOCS): pyproject.toml constraints.txt scripts/setup.sh scripts/uv_settings.py
	@scripts/setup.sh $(VENV) $(EXTRAS)
	@printf '%s' '$(CURDIR)' > $@

# The newest versions that pyproject.toml allows, for every Python and system that it names. What torch itself pins
# (libraries of CUDA) is left to torch, and the build of torch to the machine.
lock: $(READY)
	@mkdir -p build
	@eval "$$($(BIN)/python scripts/uv_settings.py)"; \
	    PATH="$$PATH:$(CURDIR)/$(BIN)" uv pip compile -q --universal --upgrade --all-extras --no-annotate --no-header \
	    --python-version $(OLDEST_PYTHON) pyproject.toml -o build/lock.txt
	@{ echo '# Written by "make lock": every package of every extra, in the versions that are tested.'; \
	    sed -E '/^(nvidia|cuda)-|^triton=/d; s/^(torch==[^+; ]*).*/\1/' build/lock.txt | uniq; } > constraints.txt

demo: $(READY)
	@echo "Drawing the survey of the demo into $(DEMO)"
	@$(BIN)/python -m survey.simulate.drawn $(DEMO)
	@$(BIN)/bathynerf process $(DEMO) --reference $(TRUTH)/reference.ply --visible $(TRUTH)/visible.ply
	@echo
	@echo "The cloud against the true bed, in the bounds of survey.toml, nothing aligned or shifted:"
	@$(BIN)/bathynerf compare $(RUN)/cloud.las $(TRUTH)/reference.ply --visible $(TRUTH)/visible.ply \
	    --bounds $(BOUNDS)
	@echo
	@echo "Cloud:   $(CURDIR)/$(RUN)/cloud.las"
	@echo "Report:  $(CURDIR)/$(RUN)/report.html"

test: $(READY_TEST) check types
	@# Compiled files are kept, whatever the environment says: a hundred tests start the program.
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses=auto --maxprocesses=4 --dist=loadfile

check: $(READY_TEST)
	@$(BIN)/python -m ruff check .
	@$(BIN)/python -m ruff format --check .

types: $(READY_TEST)
	@$(BIN)/python -m mypy

format: $(READY_TEST)
	@$(BIN)/python -m ruff check --fix .
	@$(BIN)/python -m ruff format .

bench: $(READY_TEST)
	@for name in $(BENCHMARKS); do echo "benchmarks/bench_$$name.py"; $(BIN)/python "benchmarks/bench_$$name.py"; done
	@for name in $(FIELDS); do echo "benchmarks/bench_$$name.py"; \
	    $(BIN)/python "benchmarks/bench_$$name.py" "build/bench/$$name"; done

tables: $(READY)
	@$(BIN)/python benchmarks/tables.py

stress: $(READY_TEST)
	@$(BIN)/python benchmarks/stress.py

soak: $(READY_TEST)
	@$(BIN)/python benchmarks/soak_inputs.py --seconds $(or $(SECONDS),60)
	@$(BIN)/python benchmarks/soak_kills.py --kills $(or $(KILLS),9)

# The source folder is the root, so that pages of docs/ and of the root link to each other; a warning fails.
docs: $(READY_DOCS)
	@$(BIN)/python -m sphinx -q -W --keep-going -b html -c docs/sphinx . build/site
	@echo "$(CURDIR)/build/site/docs/index.html"

licences: $(READY_TEST)
	@$(BIN)/python scripts/licences.py

clean:
	rm -rf .demo build dist docs/_api .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV) *.egg-info
