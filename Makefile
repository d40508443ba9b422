# `make demo` and `make test` set up everything they need in .venv; both start from python3 (3.10 or newer), pip and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Processes that tests run in, each on one thread: one more than there are cores, since some tests wait.
PROCESSES ?= 3
# Options of bench/run.py.
BENCH ?= --minutes 60
# Cases that `make stability` tries for each routine.
EXAMPLES ?= 500
# Files with tests that run alone, which are all that the second run collects, and files with slow tests only.
ALONE = $(shell grep -rl --include='*.py' 'mark\.alone' tests)
SLOW = $(shell grep -rl --include='*.py' '^pytestmark = pytest.mark.slow' tests)

# Compiling the tests and the package takes ten seconds in each process; the results are cached.
export PYTHONDONTWRITEBYTECODE :=

VIEWER := gsencoder/infer/page/static/viewer.js
VIEWER_SOURCES := $(wildcard viewer/src/* viewer/*.json viewer/*.mjs viewer/*.py)

.PHONY: help setup viewer demo test test-fast stability lint check bench gpu cli docs clean
help:            ## what can be made
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/: .*## */\t/'

setup: $(VENV)/.ready $(VIEWER) ## the virtual environment, and the page of `gsencoder view`

# The stamp is made last, so that an interrupted installation is done again.
$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@$(BIN)/python -c "import open3d" 2>/dev/null || echo "note: open3d cannot be loaded here (it needs Debian's libusb-1.0-0 and libgl1, or their like); only seeds.source=tsdf and a few tests use it, and the tests are skipped"
	@touch $@

viewer: $(VENV)/.ready ## the page of `gsencoder view`, with its types checked
	$(BIN)/python viewer/build.py --check

# Without a network the rest goes on; the page is tried again the next time.
$(VIEWER): $(VENV)/.ready $(VIEWER_SOURCES)
	@$(BIN)/python viewer/build.py --optional

demo: setup      ## a built-in scene through the whole pipeline; ends in outputs/demo/report.html
	$(BIN)/gsencoder demo out=outputs/demo overwrite=true

lint: setup      ## ruff and mypy
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

test: setup      ## all tests; those that need real data look for it in GSENCODER_SHARED (default ../shared)
	$(BIN)/python -m pytest -q -n $(PROCESSES) --dist worksteal -m "not alone"
	$(BIN)/python -m pytest -q -m alone $(ALONE)

test-fast: setup ## the tests that take a second at most
	$(BIN)/python -m pytest -q -n $(PROCESSES) --dist worksteal -m "not alone and not slow" $(SLOW:%=--ignore=%)

stability: setup ## searches for cases that exceed a bound of docs/numerics.md, for some minutes
	GSENCODER_STABILITY_EXAMPLES=$(EXAMPLES) $(BIN)/python -m pytest -q -n $(PROCESSES) tests/stability

check: lint test ## what continuous integration runs

bench: setup     ## the measured figures again, as far as an hour goes; outputs/bench/results.md (others: BENCH="--only 'encode*'")
	$(BIN)/python bench/run.py --out outputs/bench $(BENCH)

gpu: setup       ## ten minutes on a GPU: parity with the CPU and costs, as gpu.md and gpu.json (runs on a CPU too: GPU=--small)
	$(BIN)/python bench/gpu.py --out gpu.md $(GPU)

cli: setup       ## docs/cli.md, the reference of the command line, from the code
	$(BIN)/python docs/tooling/cli_page.py

$(VENV)/.docs: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	@touch $@

# The theme's notice of its end of life is no warning about these pages. With --quiet, --strict would let everything pass.
docs: $(VENV)/.docs ## the documentation as a site, in site/; links that lead nowhere are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

clean:           ## remove the environment and every output
	rm -rf $(VENV) outputs build dist site
