# make bench       install what runs, then score everything on the tiny suite: tables, report (results/)
# make bench-full  the same with what is slow (sampling rows, Mitsuba's shading, physics) on the whole suite
# make test        install the development tools, then lint, type-check, docs and tests
# make test-long   what make test leaves out because it takes long: notebooks, and some 170 tests; CI runs it too
# make test-large  what make test leaves out: the network at Stable Diffusion size (20 GiB of memory, minutes)
# make test-report likewise: the HTML report in Chromium (with chromedriver; an error where one is missing)
# make test-demo   likewise: the page of `unirender demo` in Chromium
# make test-latex  likewise: the LaTeX tables compiled (pdflatex with booktabs; an error where it is missing)
# make docs        the HTML documentation (docs/_build/html)
#
#   make PYTHON=/path/to/python3.11      another interpreter
#   make PIP_ARGS="..."                  options for every pip install (a package index with CPU builds of torch, say)
#   make bench BENCH_ARGS="--limit 8"    options for `unirender bench run`
#   make test PYTEST_ARGS="-k camera"    options for pytest

PYTHON ?= $(shell command -v python3.11 || echo python3)
PIP_ARGS ?=
BENCH_ARGS ?=
# Neighbouring tests go to one process while there are enough of them: they share what they set up.
PYTEST_ARGS ?= -n auto --dist worksteal
SUITE ?= tiny
OUT ?= results
# Of the multi-view table, which is not the paper's: 3 minutes each. `unirender bench run` takes 4.
VIEW_OBJECTS ?= 2

# Where it is set, every process of every run would compile what it imports again: 30 s for each of pytest's.
export PYTHONDONTWRITEBYTECODE :=

VENV := .venv
BIN := $(VENV)/bin
# Python compiles what is imported when it is: a third of what is installed, which pip would compile whole.
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check --quiet --no-compile --constraint constraints.txt $(PIP_ARGS)
REQUIREMENTS := pyproject.toml constraints.txt

.PHONY: all setup lpips-vgg bench bench-full test test-long test-large test-report test-demo test-latex
.PHONY: lint style types tests docs docs-check format clean
all: bench

# A stamp is newer than what it was installed from, so a second `make` starts at once; both live in .venv and go with it.
$(VENV)/.runtime: $(REQUIREMENTS)
	@echo "setting up $(VENV): a minute or two, once"
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable .
	touch $@

$(VENV)/.dev: $(REQUIREMENTS)
	@echo "setting up $(VENV) with the development tools: a minute or two, once"
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable '.[dev,docs,cluster,denoise,sd,demo]'
	touch $(VENV)/.runtime $@

setup: $(VENV)/.dev

# LPIPS-VGG is a 64 MB download: converted once into the user's cache; where it cannot be had its cells say n/a.
lpips-vgg: $(VENV)/.runtime
	$(BIN)/python -m unirender_evaluation.lpips_convert vgg || echo "LPIPS-VGG is not to be had here: n/a in the tables"

bench: $(VENV)/.runtime lpips-vgg
	$(BIN)/unirender bench run --suite $(SUITE) --out $(OUT) --view-objects $(VIEW_OBJECTS) $(BENCH_ARGS)

bench-full: $(VENV)/.runtime lpips-vgg
	$(BIN)/unirender bench run --suite $(SUITE) --out $(OUT) --full $(BENCH_ARGS)

lint: style types

style: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

# With node's own 4 GB it throws away, three quarters through, what it has inferred, and infers it again.
types: $(VENV)/.dev
	NODE_OPTIONS="--max-old-space-size=6144 $$NODE_OPTIONS" $(BIN)/pyright

# Type checks use one core for minutes; the documentation, and then the tests, have the others.
test: style
	$(MAKE) --jobs=2 --no-print-directory types tests

# After the documentation, which imports, and so compiles, much of what each process of pytest does.
tests: docs-check
	$(BIN)/python -m pytest $(PYTEST_ARGS)

# The notebooks run in `docs`.
test-long: docs
	$(BIN)/python -m pytest -m long $(PYTEST_ARGS)

# One process, not $(PYTEST_ARGS): it measures its own memory.
test-large: $(VENV)/.dev
	$(BIN)/python -m pytest -m large -s

test-report: $(VENV)/.dev
	$(BIN)/python -m pytest -m report

# It prints the time from a slider to its picture.
test-demo: $(VENV)/.dev
	$(BIN)/python -m pytest -m demo -s

test-latex: $(VENV)/.dev
	$(BIN)/python -m pytest -m latex

docs: $(VENV)/.dev
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet -b html docs docs/_build/html

# The same pages, read and linked but not written, with notebooks that are not run: minutes less.
docs-check: $(VENV)/.dev
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet -D nb_execution_mode=off -b dummy docs docs/_build/check

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) $(OUT) docs/_build docs/_generated dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache
