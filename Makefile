# SPDX-License-Identifier: Apache-2.0
# `make demo` and `make test` are all that is needed on a fresh machine; `make help` lists the rest.

VENV := .venv
BIN := $(VENV)/bin
DEMO_SCENE := scenes/tabletop.xml
DEMO_OUT := out/demo
export PYTHON

.DEFAULT_GOAL := help
.PHONY: help demo test test-pcgraph test-rangesim test-benchmarks validate docs coverage fuzz kernels lint format constraints audit clean system

help: ## this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /|/' | awk -F'|' '{ printf "  make %-12s %s\n", $$1, $$2 }'

demo: $(VENV)/.installed ## set up if needed, run the comparison on the tabletop scene, say where the report is
	$(BIN)/rangesim run $(DEMO_SCENE) --out $(DEMO_OUT)
	@echo "Report: $(CURDIR)/$(DEMO_OUT)/report.html"

# Each worker traces with all cores for a part of its time: more than four workers gain nothing. Files go in the order
# of tests/conftest.py, as those of most tests are not those that take longest.
PARALLEL := -n auto --maxprocesses=4 --dist loadfile --no-loadscope-reorder
test: $(VENV)/.installed-test ## set up if needed, lint, check types, run the tests but those of `make validate`
	@$(MAKE) --no-print-directory -j 2 lint kernels
	$(BIN)/python -m pytest $(PARALLEL) -m "not validation"

test-pcgraph: $(VENV)/.installed-test kernels ## the tests of pcgraph alone
	$(BIN)/python -m pytest $(PARALLEL) -m "not validation" tests/pcgraph

test-rangesim: $(VENV)/.installed-test kernels ## the tests of rangesim alone
	$(BIN)/python -m pytest $(PARALLEL) -m "not validation" --ignore tests/pcgraph --ignore tests/benchmarks

test-benchmarks: $(VENV)/.installed-test kernels ## the tests of what the benchmarks of pcgraph stand on
	$(BIN)/python -m pytest $(PARALLEL) -m "not validation" tests/benchmarks

validate: $(VENV)/.installed-test kernels ## long comparisons and statistics, before a release: docs/validation.md
	$(BIN)/python -m pytest $(PARALLEL) -m validation

kernels: $(VENV)/.installed-test # compiled once beside mypy, which leaves a core; else by each worker of the tests
	@$(BIN)/pcgraph compile > /dev/null

coverage: $(VENV)/.installed-test ## every test of both, and which lines none reaches; takes a third longer
	$(BIN)/python -m pytest $(PARALLEL) --cov --cov-report=term

docs: $(VENV)/.installed-test ## the documentation as a site, in out/docs; a warning is an error
	@scripts/setup install $(VENV) test,docs
	$(BIN)/python -m sphinx -q -W --keep-going -E -b html docs out/docs
	@echo "Documentation: $(CURDIR)/out/docs/index.html"

N := 20000
SEED := $(shell date +%Y%m%d)
JOBS := $(shell nproc 2>/dev/null || echo 1)
fuzz: $(VENV)/.installed-test ## N=100000 mutated and hostile files over all readers; new failures go to tests/fuzz/corpus
	PYTHONPATH=$(CURDIR):$(CURDIR)/tests $(BIN)/python -m fuzz --n $(N) --seed $(SEED) --jobs $(JOBS) --keep

lint: $(VENV)/.installed-test ## ruff and mypy
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: $(VENV)/.installed-test ## let ruff put the code in order
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

constraints: ## write constraints.txt anew: the newest versions within the ranges of pyproject.toml (python3.11)
	@PYTHON=$${PYTHON:-python3.11} scripts/setup constraints

audit: $(VENV)/.installed-test ## licences of all dependencies; known vulnerabilities of the pinned versions (needs network)
	$(BIN)/python scripts/licences.py
	@scripts/setup audit

clean: ## remove the environment, caches and results
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage htmlcov
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The system libraries are looked at every time, which is quick; packages are installed only when
# pyproject.toml or constraints.txt has changed.
system:
	@scripts/setup system

$(VENV)/.installed: pyproject.toml constraints.txt scripts/setup | system
	@scripts/setup venv $(VENV)
	@scripts/setup install $(VENV)
	@echo "Compiling the kernels of pcgraph (half a minute the first time) ..."
	@$(BIN)/pcgraph compile > /dev/null
	@touch $@

$(VENV)/.installed-test: pyproject.toml constraints.txt scripts/setup | system
	@scripts/setup system --test
	@scripts/setup venv $(VENV)
	@scripts/setup install $(VENV) test
	@touch $(VENV)/.installed $@
