# make run    set up .venv and run the main job; other runs: make run ARGS="task=Move variant=3"
# make test   set up .venv and run the tests but the slow ones (those marked gpu skip themselves without a GPU)
# make test-slow   the slow ones: all fifty configurations at full size, about half an hour on two cores
# make lint   check style
# make system-packages   on Debian or Ubuntu, as root: OpenGL without a screen, for pictures
# make tables   the paper's tables beside ours, from results alone: reports/tables; RESULTS=folder or archive
# make tex-packages   on Debian or Ubuntu, as root: a small LaTeX, to typeset the tables
# make clean  remove everything that can be made again, except results

PYTHON ?= python3
VENV ?= .venv
ARGS ?= task=Rope method=adam seed=0
RESULTS ?= results
REPORTS ?= reports

BIN := $(VENV)/bin

.PHONY: run test test-slow lint clean system-packages tex-packages tables

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

tex-packages:
	apt-get install -y --no-install-recommends texlive-latex-base texlive-latex-recommended

tables: $(VENV)/.run.stamp
	$(BIN)/python -m plab.report tables --results $(RESULTS) --out $(REPORTS)/tables

clean:
	rm -rf $(VENV) build dist src/*.egg-info .pytest_cache .ruff_cache .hypothesis .coverage htmlcov
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

# Installed again only when what is to be installed has changed. The dev set-up includes the other.
$(VENV)/.run.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e .
	touch $@

$(VENV)/.dev.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev]"
	touch $@ $(VENV)/.run.stamp

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
