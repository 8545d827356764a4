# Each target sets up what it needs: a virtual environment with the package and the versions that the tests ran on.
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DOCS_STAMP := $(VENV)/.installed-docs
BENCH_STAMP := $(VENV)/.installed-bench

# Two workers share the cores: threads of linear algebra beside them only wait for each other.
PYTEST := OMP_NUM_THREADS=1 MPLBACKEND=agg $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# Each check of types takes half a minute of one core.
BOTH := $(MAKE) --no-print-directory -j 2 types types-strict

.PHONY: demo test test-slow lint types types-strict docs bench notebooks clean

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test]'
	touch $(STAMP)

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[docs]'
	touch $(DOCS_STAMP)

$(BENCH_STAMP): $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test,bench]'
	touch $(BENCH_STAMP)

demo: $(STAMP)
	$(BIN)/rtac demo --out demo

test: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo
	$(BOTH)
	$(PYTEST)

test-slow: $(STAMP)
	$(PYTEST) -m slow

lint: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/lint-imports --no-logo
	$(BOTH)

types: $(STAMP)
	$(BIN)/pyright

types-strict: $(STAMP)
	$(BIN)/pyright --project pyright-strict.json

docs: $(DOCS_STAMP)
	$(BIN)/mkdocs build --strict

bench: $(BENCH_STAMP)
	$(BIN)/python benchmarks/run.py

notebooks: $(STAMP)
	for f in notebooks/*.ipynb; do $(BIN)/python -m jupyter execute --inplace $$f || exit 1; done

clean:
	rm -rf $(VENV) .cache demo site
