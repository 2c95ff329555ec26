# SPDX-License-Identifier: MIT
#
# What a person types. `make` alone names what the system lacks, or else the targets. Everything Python goes into .venv
# in this tree; a target sets up what it needs, only when something changed, and then needs no network.
#
#   ARGS=...    more arguments: make test ARGS="-k decode", make demo ARGS="--help"
#   PYTHON=...  the Python that .venv is made of

PYTHON ?= python3
VENV   ?= .venv
ARGS   ?=

# Not the shell's own Python settings: what is tested is this tree in this environment.
unexport PYTHONPATH PYTHONHOME
PY      := $(VENV)/bin/python
PIP     := $(PY) -m pip --quiet --disable-pip-version-check install
SOURCES := $(shell find csrc include -name '*.[ch]') setup.py dpmaster/_build.py

CORE     := $(wildcard csrc/core/*.c)
LINUX    := $(wildcard csrc/linux/*.c)
PROGRAMS := $(wildcard tests/bench/*.c tests/fuzz/*.c tests/uart/*.c tests/cross/*.c)
# -fno-strict-overflow, as newer Pythons compile extensions: it makes gcc see more.
CSTRICT  := -std=c11 -O2 -fno-strict-overflow -Iinclude -Icsrc -Wall -Wextra -Wshadow -Wconversion -Werror
FUZZ     := $(patsubst tests/fuzz/%.c,build/fuzz/%,$(wildcard tests/fuzz/*.c))
FUZZ_SECONDS ?= 30

.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help check demo test test-uart cross soak lint bench fuzz sanitize dist clean

help: check
	@echo "make demo      start a drive on a virtual bus and watch it run"
	@echo "make test      run the tests"
	@echo "make test-uart the library on the UARTs of a real kernel: a PL011 and a 16550 in QEMU"
	@echo "make cross     the library as arm64 and armhf under emulation, its core for a Cortex-M"
	@echo "make lint      ruff, mypy --strict, gcc and clang with all warnings as errors"
	@echo "make soak      the long proofs: random rings, and cycles with random faults, by the million"
	@echo "make bench     measure the speed"
	@echo "make fuzz      run each fuzz target for $(FUZZ_SECONDS) s"
	@echo "make sanitize  run the tests with AddressSanitizer and UndefinedBehaviorSanitizer in the C library"
	@echo "make dist      build the source distribution and the wheel"
	@echo "make clean     remove what was built, .venv too"

# One line for each thing that is missing and one command that brings all of them.
check:
	@packages=""; \
	lacks() { echo "missing: $$1"; case " $$packages " in *" $$2 "*) ;; *) packages="$$packages $$2";; esac; }; \
	if ! command -v "$(PYTHON)" >/dev/null 2>&1; then lacks "$(PYTHON), version 3.11 or later" python3; \
	    lacks "Python's venv module" python3-venv; lacks "Python.h" python3-dev; \
	elif ! "$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then \
	    echo "missing: Python 3.11 or later; $(PYTHON) is `$(PYTHON) -V 2>&1`. Debian and Raspberry Pi OS have it since release 12; or name another one: make PYTHON=python3.11"; \
	    exit 1; \
	else \
	    "$(PYTHON)" -c 'import venv, ensurepip' 2>/dev/null || lacks "Python's venv module" python3-venv; \
	    "$(PYTHON)" -c 'import os, sys, sysconfig; sys.exit(not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")))' \
	        || lacks "Python.h" python3-dev; \
	fi; \
	if ! command -v "$(CC)" >/dev/null 2>&1; then lacks "a C compiler ($(CC))" "gcc libc6-dev"; \
	elif ! echo '#include <stdio.h>' | "$(CC)" -E - >/dev/null 2>&1; then lacks "the C library's headers" libc6-dev; fi; \
	if [ -n "$$packages" ]; then echo "to install:  sudo apt-get install$$packages"; exit 1; fi

# --- set-up ----------------------------------------------------------------------------------------------------------

# The environment with what builds the package (pyproject.toml's build-system), so that no later build asks the network.
$(VENV)/.made: | check
	@echo "making $(VENV) ..."
	$(PYTHON) -m venv $(VENV)
	$(PIP) $(call listed,$(PYTHON),["build-system"]["requires"])
	@touch $@

$(VENV)/.run: pyproject.toml setup.py | $(VENV)/.made
	@echo "building dpmaster ..."
	$(PIP) --no-build-isolation --editable .
	@touch $@

# The compiled half again, when its sources changed.
$(VENV)/.built: $(SOURCES) $(VENV)/.run
	$(PY) setup.py --quiet build_ext --inplace
	@touch $@

# What an extra of pyproject.toml lists: .test, .lint, .bench, .dist.
$(VENV)/.%: pyproject.toml | $(VENV)/.made
	$(PIP) $(call listed,$(PY),["project"]["optional-dependencies"]["$*"])
	@touch $@

# The requirements at a place in pyproject.toml, each quoted.
listed = $(shell $(1) -c 'import shlex, tomllib; print(shlex.join(tomllib.load(open("pyproject.toml", "rb"))$(2)))')

# --- use -------------------------------------------------------------------------------------------------------------

demo: $(VENV)/.built
	@$(PY) -m dpmaster demo $(ARGS)

test: $(VENV)/.built $(VENV)/.test
	$(PY) -m pytest $(ARGS)

# Debian's arm64 kernel is fetched once, into build/uart. What the machine lacks is named, and the tests are skipped.
test-uart: $(VENV)/.built $(VENV)/.test
	$(PY) -m pytest tests/uart/uart.py $(ARGS)

cross: $(VENV)/.built $(VENV)/.test
	$(PY) -m pytest tests/cross/cross.py $(ARGS)

# Longer proofs than a change has to wait for: 10 000 random rings, 10 000 cycles of a single master at each rate, an hour of
# two masters with 20 slaves on virtual time, a minute of two masters side by side on ptys, and cycles with random faults, 10
# million on virtual time and a million on a pty, 2000 programs that do anything, every disturbance at every moment of a program.
soak: $(VENV)/.built $(VENV)/.test
	DPM_SOAK_RUNS=10000 DPM_SOAK_CYCLES=10000 DPM_SOAK_SECONDS=3600 $(PY) -m pytest --capture=no tests/test_ring_soak.py $(ARGS)
	DPM_RING_SECONDS=60 $(PY) -m pytest --timeout=600 tests/test_ring_pty.py
	DPM_DP_CYCLES=10000000 DPM_PTY_CYCLES=1000000 $(PY) -m pytest --capture=no tests/test_dp_soak.py $(ARGS)
	DPM_PROGRAMS=2000 $(PY) -m pytest tests/test_outputs.py $(ARGS)
	DPM_CASES=0 DPM_PAIRS=50000 $(PY) -m pytest --capture=no tests/test_disturbances.py $(ARGS)
	DPM_REQUESTS=2000 $(PY) -m pytest --timeout=1800 tests/test_sip3_model.py

bench: $(VENV)/.built $(VENV)/.bench
	$(PY) tests/bench/bench.py $(ARGS)

lint: $(VENV)/.run $(VENV)/.lint
	@for cc in gcc clang; do command -v $$cc >/dev/null || \
	    { echo "make lint needs $$cc, which is missing: sudo apt-get install $$cc"; exit 1; }; done
	$(PY) -m ruff check .
	$(PY) -m mypy
	@for cc in gcc clang; do \
	    echo "$$cc $(CSTRICT)"; \
	    for file in $(CORE); do $$cc $(CSTRICT) -ffreestanding -c -o /dev/null $$file || exit 1; done; \
	    for file in $(CORE) $(LINUX) $(PROGRAMS); do $$cc $(CSTRICT) -D_GNU_SOURCE -c -o /dev/null $$file || exit 1; done; \
	done

# A build of its own, so that the usual one stays as it is. -P keeps the tree's dpmaster/ out of the way; a sanitizer's
# report goes past pytest's capture. Leaks are not looked for: the interpreter has too many of its own.
SANITIZERS := -fsanitize=address,undefined -fno-sanitize-recover=undefined
sanitize: $(VENV)/.built $(VENV)/.test
	DPM_CFLAGS="$(SANITIZERS) -fno-omit-frame-pointer -g -O1" DPM_LDFLAGS="$(SANITIZERS)" \
	    $(PY) setup.py --quiet build --build-base build/sanitize --build-lib build/sanitize/lib
	ln -sfn $(CURDIR)/include $(CURDIR)/csrc build/sanitize/lib/
	LD_PRELOAD="$$($(CC) -print-file-name=libasan.so) $$($(CC) -print-file-name=libubsan.so)" \
	    ASAN_OPTIONS=detect_leaks=0 PYTHONMALLOC=malloc PYTHONPATH=build/sanitize/lib \
	    $(PY) -P -m pytest --capture=no --quiet -m "not tree" $(ARGS)

fuzz: $(FUZZ)
	@for target in $(FUZZ); do \
	    corpus=build/fuzz/corpus-$$(basename $$target); mkdir -p $$corpus; \
	    $$target -max_total_time=$(FUZZ_SECONDS) -print_final_stats=1 $$corpus $(ARGS) || exit 1; \
	done

build/fuzz/%: tests/fuzz/%.c $(SOURCES)
	@command -v clang >/dev/null || { echo "make fuzz needs clang, which is missing: sudo apt-get install clang"; exit 1; }
	@mkdir -p build/fuzz
	clang -std=c11 -D_GNU_SOURCE -O1 -g -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=undefined \
	    -Iinclude -Icsrc -pthread -o $@ $< $(CORE) $(LINUX)

dist: $(VENV)/.run $(VENV)/.dist
	$(PY) -m build --no-isolation

clean:
	rm -rf $(VENV) build dist *.egg-info dpmaster/_dpm.c dpmaster/_dpm*.so
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
