# One command per chore; .ci/run calls the same ones.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
CORE   := core/build.py $(wildcard core/include/echospline/* core/src/*)
NATIVE := $(wildcard core/include/echospline/* core/src/* core/tests/*.c core/tests/*.cpp core/hosts/*/*.c)

# Warnings of the core's compiler are errors here, not on a user's machine.
export ECHOSPLINE_STRICT := 1

.PHONY: setup demo live test check core-check core-sanitize core-fuzz wasm wheels format clean

setup: $(VENV)/.ready build/core/.library

$(VENV)/.ready: pyproject.toml package.json
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "echospline needs Python 3.11 or newer; got $$($(PYTHON) --version). Try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable . --group dev
	@if command -v npm >/dev/null; then npm install --silent --no-package-lock --no-audit --no-fund; \
	  else echo "npm is not here: the types of the page's JavaScript are not checked"; fi
	@touch $@

build/core/.library: $(CORE) | $(VENV)/.ready
	$(BIN)/python core/build.py
	@touch $@

wasm: build/core/.wasm
build/core/.wasm: $(CORE) | $(VENV)/.ready
	$(BIN)/python core/build.py wasm
	@touch $@

wheels: setup
	$(BIN)/python core/wheels.py

demo: setup
	$(BIN)/echospline demo --out out/demo

live: setup wasm
	$(BIN)/echospline live

check: setup core-check
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	@if [ -x node_modules/.bin/tsc ]; then echo node_modules/.bin/tsc; node_modules/.bin/tsc; \
	  else echo "typescript is not installed (npm): the types of the page's JavaScript are not checked"; fi

core-check: setup
	$(BIN)/clang-format --dry-run --Werror $(NATIVE)
	$(BIN)/python core/build.py strict
	@tidy=$$(command -v $(BIN)/clang-tidy clang-tidy | head -n 1); \
	if [ -n "$$tidy" ]; then echo "$$tidy core/src/*.cpp"; \
	  "$$tidy" --quiet core/src/*.cpp -- -std=c++20 -fno-exceptions -Wno-psabi; \
	else echo "clang-tidy is not installed (pip or apt): the core is checked by the compiler's warnings alone"; fi

core-sanitize: setup # the core's own tests under the address and undefined behaviour sanitizers
	$(BIN)/python core/tests/run.py --sanitize

FUZZ_SECONDS := 60
core-fuzz: setup # the C interface under random misuse, for FUZZ_SECONDS
	$(BIN)/python core/tests/run.py --fuzz $(FUZZ_SECONDS)

BROWSER := $(patsubst %,tests/test_%.py,viewer_page page_browser page_served page_pack class_view)
test: setup wasm
	tests/install-system
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile $(BROWSER:%=--ignore=%)
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile $(BROWSER) # a browser's event loop stays in processes of its own

format: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/clang-format -i $(NATIVE)

clean:
	rm -rf $(VENV) node_modules out build dist src/echospline/_native/*.so src/echospline/_native/*.dylib \
	  src/echospline/_native/*.dll src/echospline/_native/*.wasm .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
