# Everything sets itself up: `make demo` and `make test` work on a machine with Python >= 3.11, git and make.
PYTHON ?= python3
VENV   ?= .venv
BIN     = $(VENV)/bin
READY   = $(VENV)/.ready
OUT    ?= demo

# Without byte code on the disk every worker and every command that a test starts would compile all modules again.
export PYTHONDONTWRITEBYTECODE =

.PHONY: setup demo test test-arithmetic test-arithmetic-all test-slow check bench peers bench-peers notebooks site wheel-check clean
setup: $(READY)

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, found " + sys.version)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt torch numpy
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	@touch $@

demo: setup
	$(BIN)/metalens demo $(OUT) --force

# Threads of a worker that wait do not spin: two of them beside another worker took four times their processor time.
# Loops are compiled once, before the workers begin.
test: setup
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m tests.warm
	OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive NUMBA_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -m 'not slow'

# The numeric tests under the arithmetic of other processors, and compiled loops as they are written; -all: the whole default suite under each of them.
test-arithmetic: setup
	$(BIN)/python tests/arithmetic.py

test-arithmetic-all: setup
	$(BIN)/python tests/arithmetic.py all

test-slow: setup
	$(BIN)/python -m pytest -m slow

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: setup
	$(BIN)/python -m benchmarks

# The projects that the benchmarks compare with live in an environment of their own: never a dependency.
peers: setup
	test -x .venv-peers/bin/python || $(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet -c constraints.txt torch numpy
	.venv-peers/bin/python -m pip install --quiet -r benchmarks/peers.txt
	.venv-peers/bin/python -m pip install --quiet -c constraints.txt -e .

bench-peers: peers
	.venv-peers/bin/python -m benchmarks --peers

notebooks: setup
	$(BIN)/python -m examples.run

# The documentation, in build/site: opens from the disk, needs no network. Broken links stop it; keys without a text fail a test.
site: setup
	$(BIN)/mkdocs build --strict --quiet

# The wheel holds every file of the packages and, installed where nothing of this folder can be seen, runs the chain of a small lens.
wheel-check: setup
	rm -rf build/wheel && mkdir -p build/wheel
	$(BIN)/python -m pip wheel --quiet --no-deps -w build/wheel .
	$(BIN)/python .ci/wheel.py build/wheel/*.whl
	$(BIN)/python -m tests.small build/wheel/chain
	$(PYTHON) -m venv build/wheel/venv
	build/wheel/venv/bin/python -m pip install --quiet -c constraints.txt torch numpy
	build/wheel/venv/bin/python -m pip install --quiet -c constraints.txt "$$(echo build/wheel/*.whl)[codesign]"
	cd build/wheel && venv/bin/metalens demo demo --config chain/chain.toml

clean:
	rm -rf $(VENV) .venv-peers build *.egg-info $(OUT)
