# make run    set up .venv and run the main job; other runs: make run ARGS="task=Move variant=3"
# make test   set up .venv and run the tests but the slow ones (those marked gpu skip themselves without a GPU)
# make test-slow   the slow ones: all fifty configurations at full size, about half an hour on two cores
# make lint   check style
# make system-packages   on Debian or Ubuntu, as root: OpenGL without a screen, for pictures
# make tables   the paper's tables beside ours, from results alone: reports/tables; RESULTS=folder or archive, or
#               RESULTS=example: real runs that come with plab
# make curves   the paper's curves and more, from results alone: reports/curves
# make report   notebooks on reproduction, speed, accuracy and a single run: reports/notebooks/*.html
# make html     a page of all results, with curves, pictures and films: reports/html/index.html
# make browser-packages   on Debian or Ubuntu, as root: Chromium, with which the page is tested
# make tex-packages   on Debian or Ubuntu, as root: a small LaTeX, to typeset the tables
# make clean  remove everything that can be made again, except results

PYTHON ?= python3
VENV ?= .venv
ARGS ?= task=Rope method=adam seed=0
RESULTS ?= results
REPORTS ?= reports

BIN := $(VENV)/bin

.PHONY: run test test-slow lint clean system-packages tex-packages browser-packages tables curves report html

run: $(VENV)/.run.stamp
	$(BIN)/python -m plab.run $(ARGS)

test: $(VENV)/.dev.stamp
	$(BIN)/python -m pytest -m "not slow"

test-slow: $(VENV)/.dev.stamp
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/.dev.stamp
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .

system-packages:
	apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri

browser-packages:
	apt-get install -y --no-install-recommends chromium chromium-driver

tex-packages:
	apt-get install -y --no-install-recommends texlive-latex-base texlive-latex-recommended

tables: $(VENV)/.run.stamp
	$(BIN)/python -m plab.report tables --results $(RESULTS) --out $(REPORTS)/tables

curves: $(VENV)/.run.stamp
	$(BIN)/python -m plab.report curves --results $(RESULTS) --out $(REPORTS)/curves

report: $(VENV)/.report.stamp
	$(BIN)/python -m plab.report notebooks --results $(RESULTS) --out $(REPORTS)/notebooks

html: $(VENV)/.report.stamp
	$(BIN)/python -m plab.report html --results $(RESULTS) --out $(REPORTS)/html

clean:
	rm -rf $(VENV) build dist src/*.egg-info .pytest_cache .ruff_cache .hypothesis .coverage htmlcov
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

# Installed again only when what is to be installed has changed. The dev set-up includes the other.
$(VENV)/.run.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e .
	touch $@

$(VENV)/.report.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e ".[report]"
	touch $@ $(VENV)/.run.stamp

$(VENV)/.dev.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev]"
	touch $@ $(VENV)/.run.stamp $(VENV)/.report.stamp

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
