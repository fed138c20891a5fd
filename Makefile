# Set-up and checks. `make demo` and `make test` need nothing but make and Python >= 3.11.
#
#   make demo PYTHON=python3.12         another Python
#   make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu
#                                       the CPU build of torch (on Linux, PyPI's is the CUDA build: gigabytes).
#                                       Nothing else is taken from there: with --extra-index-url, a package of any
#                                       name could be.
#   make demo PIP_ARGS=--no-cache-dir   other options of pip
#   make test TESTS=tests/propagation       a part of the tests

VENV ?= .venv
PIP_ARGS ?=
TORCH_INDEX ?=
TESTS ?=
RUN_EXTRAS := trace,train
TEST_EXTRAS := test
CONSTRAINTS := constraints.txt

FAST_TESTS := $(addprefix tests/,effects geo importing inference io links maps propagation scene test_layout.py)

BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed-$(RUN_EXTRAS)
TESTABLE := $(VENV)/.installed-$(TEST_EXTRAS)
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11; do \
	if $$python -c '$(NEW_ENOUGH)' 2> /dev/null; then echo $$python; break; fi; done)

SUDO := $(if $(filter 0,$(shell id -u)),,sudo -n)
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses 2 --dist worksteal
CAN_APT := command -v apt-get > /dev/null && $(SUDO) true 2> /dev/null
APT_INSTALL := $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=120 install -y -q

.PHONY: help demo test test-all test-flower lint fast check docs bench llvm clean

help:
	@echo "make demo    set up, then the whole chain on a small city"
	@echo "make test     set up, then every test but the slow ones (about eight minutes on two cores)"
	@echo "make test-all every test: statistics over many seeds, real data where it is, long chains"
	@echo "make test-flower the tests of federation over Flower, in an environment of their own"
	@echo "make lint     ruff and mypy"
	@echo "make check    these and the fast tests (about two minutes on two cores)"
	@echo "make docs    the site, in site/; runs the examples"
	@echo "make bench   what takes how long; \`python -m studies --list\` lists all studies"
	@echo "make llvm    set up only: the package and a libLLVM for tracing"
	@echo "make clean   remove the environment and what the tools left"

demo: llvm
	$(BIN)/radiotwin demo

test: $(TESTABLE)
	@$(MAKE) --no-print-directory RUN_EXTRAS=$(TEST_EXTRAS) llvm \
	|| echo "make test: without a libLLVM the tests that trace rays are skipped; all the others run." >&2
	$(PYTEST) -m "not slow" $(TESTS)

test-all: $(TESTABLE)
	$(PYTEST) $(TESTS)

# Flower pins older versions of typer, rich, packaging and protobuf than constraints.txt has.
test-flower:
	$(MAKE) --no-print-directory VENV=$(VENV)-flower TEST_EXTRAS=test,flower CONSTRAINTS=constraints-flower.txt \
		$(VENV)-flower/.installed-test,flower
	OMP_NUM_THREADS=1 $(VENV)-flower/bin/python -m pytest --numprocesses 0 tests/marl/test_flower.py tests/marl/test_client.py

lint: $(TESTABLE)
	$(BIN)/ruff check
	$(BIN)/mypy

# mypy takes one core for most of this time; the tests have the other.
check: $(TESTABLE)
	@$(MAKE) --no-print-directory -j 2 lint fast

fast: $(TESTABLE)
	$(PYTEST) -m "not slow and not llvm and not seconds" $(FAST_TESTS)

# In a folder of its own, where the examples leave what they make.
docs: $(TESTABLE)
	$(BIN)/python -m pip install --disable-pip-version-check -q $(PIP_ARGS) -c constraints.txt -e '.[docs]'
	mkdir -p build/docs
	cd build/docs && OMP_NUM_THREADS=1 $(abspath $(BIN))/mkdocs build --strict -f $(CURDIR)/mkdocs.yml -d $(CURDIR)/site

bench: llvm
	rm -rf build/speed
	$(BIN)/python -m studies speed --out build/speed

# The second run does nothing, until what is to be installed has changed.
$(VENV)/.installed-%: pyproject.toml $(CONSTRAINTS)
	@$(BIN)/python -m pip --version > /dev/null 2>&1 || $(MAKE) --no-print-directory $(VENV)
	@[ -z "$(TORCH_INDEX)" ] || $(BIN)/python -m pip install --disable-pip-version-check --no-deps \
		--index-url "$(TORCH_INDEX)" "$$(grep '^torch==' $(CONSTRAINTS))"
	$(BIN)/python -m pip install --disable-pip-version-check $(PIP_ARGS) -c $(CONSTRAINTS) -e '.[$*]'
	@touch $@

# Debian and Ubuntu keep the module venv in a package of its own.
.PHONY: $(VENV)
$(VENV):
	@if [ -z "$(PYTHON)" ] || ! $(PYTHON) -c '$(NEW_ENOUGH)'; then \
		echo "radiotwin needs Python 3.11 or newer, and $(or $(PYTHON),python3) is not: install one," \
			"or name it with PYTHON=/path/to/python3.11" >&2; exit 1; fi
	@$(PYTHON) -m venv --clear $(VENV) || { $(CAN_APT) && $(SUDO) apt-get update -q \
		&& $(APT_INSTALL) $(notdir $(PYTHON))-venv && $(PYTHON) -m venv --clear $(VENV); }

# Tracing needs a libLLVM that Dr.Jit can use. The package finds one or says how to install it; with apt, and the
# right to use it without a question, it is installed here. Who names one in DRJIT_LIBLLVM_PATH has that one.
llvm: $(INSTALLED)
	@if ! $(BIN)/python -m radiotwin.runtime.llvm > /dev/null 2>&1 && [ -z "$$DRJIT_LIBLLVM_PATH" ] \
		&& $(CAN_APT); then \
		$(SUDO) apt-get update -q; \
		for package in libllvm19 libllvm20 libllvm21 libllvm18 libllvm17; do \
			$(APT_INSTALL) $$package && break; done; fi >&2 || true
	@$(BIN)/python -m radiotwin.runtime.llvm

clean:
	rm -rf $(VENV) $(VENV)-flower build dist site *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find radiotwin marl tests studies -name __pycache__ -prune -exec rm -rf {} +
