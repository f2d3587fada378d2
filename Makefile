# `make demo` sets everything up and runs the whole job; `make test` sets up and tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: install install-locked lock install-dev resolve demo test test-thorough test-slow lint docs clean

install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "cpunet needs Python 3.11 or newer; try make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(PIP) -e '.[networks]'
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) -e '.[dev]'
	@echo compiling the loops that tests share: a minute or two
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/python tests/compiled.py
	touch $@

demo: install
	$(BIN)/cpunet demo --out demo

# a process a core; those that tests start need not compile the package's modules each time
PYTEST := env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest -n auto --dist worksteal

test: install-dev
	$(PYTEST)

# further variants of what `make test` proves: some minutes more
test-thorough: install-dev
	$(PYTEST) -m 'thorough and not slow'

# with CPUNET_SLOW_MINUTES=15 none is begun after so long
test-slow: install-dev
	$(PYTEST) -m 'slow or hypothesis' --hypothesis-profile=full

lint: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# could LEGEND's chain be installed beside it, the newest and the oldest that was tested, and all of
# it for the newest Python? (dry runs)
RESOLVE := $(BIN)/python -m pip install --quiet --disable-pip-version-check --dry-run .
NEWEST := --python-version 3.14 --only-binary :all: --ignore-installed --target $(VENV)/newest
resolve: install
	$(RESOLVE)[networks] $(NEWEST)
	$(RESOLVE) --upgrade legend-lh5io legend-pydataobj dspeed pygama reboost
	$(RESOLVE) legend-lh5io==0.2.3 legend-pydataobj==2.0.1 dspeed==2.1.4 pygama==2.3.10 reboost==1.0.0

# site/index.html, which needs no network; a warning is an error
docs: install-dev
	$(BIN)/python docs/hooks/diagrams.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

# versions and digests of all that is installed, for this Python and system
lock: install
	$(BIN)/python benchmarks/lock.py

# nothing but the files with these digests, where CPython 3.11 on Linux is
install-locked:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps -e .
	touch $(VENV)/.installed

clean:
	rm -rf $(VENV) site .mypy_cache .ruff_cache .pytest_cache .hypothesis
