# One command per chore; .ci/run calls the same ones.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

.PHONY: setup demo live test check format clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml package.json
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "echospline needs Python 3.11 or newer; got $$($(PYTHON) --version). Try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable . --group dev
	@if command -v npm >/dev/null; then npm install --silent --no-package-lock --no-audit --no-fund; \
	  else echo "npm is not here: the types of the page's JavaScript are not checked"; fi
	@touch $@

demo: setup
	$(BIN)/echospline demo --out out/demo

live: setup
	$(BIN)/echospline live

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	@if [ -x node_modules/.bin/tsc ]; then echo node_modules/.bin/tsc; node_modules/.bin/tsc; \
	  else echo "typescript is not installed (npm): the types of the page's JavaScript are not checked"; fi

test: setup
	tests/install-system
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --ignore tests/test_viewer_page.py
	$(BIN)/python -m pytest tests/test_viewer_page.py # a browser's event loop stays in its process

format: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) node_modules out build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
