# make run    set up .venv and run the main job; other runs: make run ARGS="task=Move variant=3"
# make test   set up .venv and run the tests, in nine minutes on two cores
# make dev    set up .venv for work on plab itself: development tools, tools of the docs, commit hooks
#
# With the development tools; CONTRIBUTING.md has more about them:
# make test-all    the tests of make test, and those worth running nightly: kills, disks, fuzzing, launchers, browser,
#                  all fifty configurations
# make test-gpu    the tests that need a CUDA device, and the simulator's own tests on CUDA
# make lint        style, spelling, imports, unused code and dependencies
# make typecheck   types of src/
# make coverage    which lines of src/ the tests run, kernels left out
# make benchmark   what everyday use waits for, beside what was measured the last time
# make docs        the documentation as a site, in site/; make docs-serve shows it while it is written
# make build       wheel and sdist in dist/, and a run of the wheel in an environment and a folder of its own
#
# make tables   the paper's tables beside ours, from results alone: reports/tables; RESULTS=folder or archive, or
#               RESULTS=example: real runs that come with plab
# make curves   the paper's curves and more, from results alone: reports/curves
# make report   notebooks on reproduction, speed, accuracy and a single run: reports/notebooks/*.html
# make html     a page of all results, with curves, pictures and films: reports/html/index.html
#
# make system-packages    on Debian or Ubuntu, as root: OpenGL without a screen, for pictures
# make browser-packages   the same: Chromium, with which the page is tested
# make tex-packages       the same: a small LaTeX, to typeset the tables
# make clean    remove everything that can be made again, except results and the measurements of make benchmark

PYTHON ?= python3
VENV ?= .venv
ARGS ?= task=Rope method=adam seed=0
RESULTS ?= results
REPORTS ?= reports

BIN := $(VENV)/bin

# Files that simulate the same task stay in one process, which compiles kernels once: tests/conftest.py.
# A test that hangs is ended after 15 minutes.
PARALLEL = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder -p no:benchmark --durations=20 -o faulthandler_timeout=900 -o faulthandler_exit_on_timeout=true

.PHONY: run dev test test-all test-gpu lint typecheck coverage benchmark docs docs-serve build clean system-packages \
	tex-packages browser-packages tables curves report html

run: $(VENV)/.run.stamp
	$(BIN)/python -m plab.run $(ARGS)

dev: $(VENV)/.dev.stamp $(VENV)/.docs.stamp
	$(BIN)/pre-commit install

test: $(VENV)/.dev.stamp
	$(PARALLEL)

test-all: $(VENV)/.dev.stamp
	$(PARALLEL) -m "not gpu"

test-gpu: $(VENV)/.dev.stamp
	PLAB_TEST_DEVICE=cuda $(PARALLEL) -m "gpu and not nightly"

lint: $(VENV)/.dev.stamp
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/typos
	$(BIN)/lint-imports
	$(BIN)/vulture
	$(BIN)/deptry .

typecheck: $(VENV)/.dev.stamp
	$(BIN)/python -m mypy

coverage: $(VENV)/.dev.stamp
	$(PARALLEL) --cov --cov-report=term --cov-report=html

benchmark: $(VENV)/.dev.stamp
	$(BIN)/python -m pytest benchmarks --benchmark-autosave --benchmark-compare --benchmark-columns=min,median,rounds

docs: $(VENV)/.docs.stamp
	$(BIN)/python -m properdocs build --strict -f mkdocs.yml

docs-serve: $(VENV)/.docs.stamp
	$(BIN)/python -m properdocs serve -f mkdocs.yml

build: $(VENV)/.dev.stamp
	$(BIN)/python -m build
	PYTHON=$(BIN)/python tools/check_wheel.sh

system-packages:
	apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri

browser-packages:
	apt-get install -y --no-install-recommends chromium chromium-driver

tex-packages:
	apt-get install -y --no-install-recommends texlive-latex-base texlive-latex-recommended

tables: $(VENV)/.run.stamp
	$(BIN)/python -m plab.report tables $(RESULTS) --output $(REPORTS)/tables

curves: $(VENV)/.run.stamp
	$(BIN)/python -m plab.report curves $(RESULTS) --output $(REPORTS)/curves

report: $(VENV)/.report.stamp
	$(BIN)/python -m plab.report notebooks $(RESULTS) --output $(REPORTS)/notebooks

html: $(VENV)/.report.stamp
	$(BIN)/python -m plab.report html $(RESULTS) --output $(REPORTS)/html

clean:
	rm -rf $(VENV) build dist site src/*.egg-info .coverage htmlcov
	rm -rf .pytest_cache .ruff_cache .mypy_cache .hypothesis .import_linter_cache
	find src benchmarks tests tools -name __pycache__ -type d -prune -exec rm -rf {} +

# Installed again only when what is to be installed has changed. The dev set-up includes that of runs.
$(VENV)/.run.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e .
	touch $@

$(VENV)/.report.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e ".[report]"
	touch $@ $(VENV)/.run.stamp

$(VENV)/.dev.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev]"
	touch $@ $(VENV)/.run.stamp $(VENV)/.report.stamp

$(VENV)/.docs.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e ".[docs]"
	touch $@

$(BIN)/python:
	@$(PYTHON) -c "import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 15))" || { \
		echo "plab needs Python 3.10 to 3.14, not $$($(PYTHON) --version 2>&1): add PYTHON=python3.12" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
