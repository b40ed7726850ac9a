PYTHON ?= python3.11
ARGS ?=
BUDGET ?= smoke
BIN := .venv/bin
INSTALLED := .venv/.installed

.DEFAULT_GOAL := help
.PHONY: help venv train evaluate bench reproduce docs test test-all test-bench test-extras test-wheel test-versions kill-test check format wheel clean

help: ## show this list
	@echo "make TARGET [ARGS='...']"
	@sed -n 's/^\([a-z-]*\):.*## /  \1@/p' $(MAKEFILE_LIST) | while IFS=@ read -r target text; do \
		printf '  %-10s %s\n' $$target "$$text"; done

venv: $(INSTALLED) ## make .venv with the tested versions (PYTHON=... selects the interpreter)

$(INSTALLED): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { \
		echo "$(PYTHON) was not found; install Python 3.11 to 3.13, or name yours: make PYTHON=/path/to/python" >&2; exit 2; }
	@echo "Installing coil-rl, PyTorch and the developer tools into .venv (a few minutes the first time) ..."
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

train: $(INSTALLED) ## train an agent with a guide's advice, e.g. ARGS='seed=1'
	$(BIN)/coil-train method=coil $(ARGS)

evaluate: $(INSTALLED) ## evaluate a trained agent, e.g. ARGS='run=outputs/train/THE_RUN'
	$(BIN)/coil-evaluate $(ARGS)

# A comparison of speeds means something only if both compute the same.
bench: test-bench ## measure the speed of everything, e.g. ARGS='--device cuda'
	$(BIN)/python -m benchmarks $(ARGS)

reproduce: $(INSTALLED) ## make every result of the paper at the smallest budget (BUDGET=paper for the real one)
	$(BIN)/coil-reproduce all=true budget=$(BUDGET) $(ARGS)

# The source folder is the checkout, so that links lead to the same files as in the repository.
docs: $(INSTALLED) ## build the documentation into build/docs, offline; a warning is an error
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -q -W --keep-going -c docs -b html . build/docs $(ARGS)
	@echo "build/docs/index.html"

test: $(INSTALLED) ## run the fast tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile $(ARGS)

test-all: $(INSTALLED) ## run all tests, also the slow ones
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile -m '' $(ARGS)

# Stable-Baselines3 is needed for this comparison only; without it these tests are skipped.
test-bench: $(INSTALLED) ## install Stable-Baselines3 and run the tests that compare with it
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[bench]'
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/coil_rl/learners/test_ppo_sb3.py tests/benchmarks/test_beside_sb3.py tests/benchmarks/test_advice_for_sb3.py

# The packages of the loggers are needed for this only; without them these tests are skipped.
test-extras: $(INSTALLED) ## install Weights & Biases and MLflow and run the tests of the loggers
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[wandb,mlflow]'
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -m '' tests/coil_rl/config/test_trust.py tests/coil_rl/programs/test_loggers.py

test-wheel: $(INSTALLED) ## run the tests that need no checkout with a wheel in a bare environment
	$(BIN)/python tests/try_wheel.py $(ARGS)

test-versions: $(INSTALLED) ## try the floor and the ceiling of each range (minutes and gigabytes each)
	$(BIN)/python tests/try_versions.py $(ARGS)

kill-test: $(INSTALLED) ## kill 20 short trainings at random moments, resume and compare (20 minutes)
	$(BIN)/python tests/kill_and_resume.py --kills 20 $(ARGS)

check: $(INSTALLED) ## lint, formatting, types and import directions
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p coil_rl -p coil_fmu -p coil_paper -p coil_robot -p coil_studies -p benchmarks
	$(BIN)/lint-imports --no-logo

format: $(INSTALLED) ## format the code and apply the automatic lint fixes
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

# Files left in build/ by an earlier version would end up in the wheel.
wheel: $(INSTALLED) ## build a wheel into dist/
	rm -rf build
	$(BIN)/python -m build --wheel --no-isolation

clean: ## remove build products and caches; .venv and outputs/ stay
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -path ./.venv -prune -o -type d -name __pycache__ -exec rm -rf {} +
