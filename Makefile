# Everything a fresh machine with Python >= 3.11 needs: `make demo`, `make test`.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Written when the environment is complete, and older than what it was made from when it is not.
READY := $(VENV)/.ready
OUT ?= out/paper

.PHONY: demo test check nightly audit format gazebo clean

demo: $(READY)  ## The paper, from five sets of failed demonstrations; ends with the report's path.
	$(BIN)/misstep reproduce --quick --out $(OUT)

test: $(READY) check  ## Every check and every test.
	$(BIN)/pytest -n 2 --ignore tests/test_hot_paths.py

check: $(READY)  ## Lint, format, types, imports, the documentation, instructions of the hot paths.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	$(BIN)/pytest -q tests/test_hot_paths.py

nightly: $(READY)  ## Mixtures and donuts against sixty digits, 10,000 examples of each property.
	HYPOTHESIS_PROFILE=nightly $(BIN)/pytest tests/test_numerical_stress.py

audit: $(READY)  ## Known flaws of the dependencies, from a service on the network.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pip-audit
	$(BIN)/pip-audit --strict -r constraints.txt

format: $(READY)  ## Mend what can be mended by a machine.
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "misstep needs Python 3.11 or newer; set PYTHON=/path/to/it")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $(READY)

gazebo: $(READY)  ## The bridge to Gazebo's physics, for the system cartpole-gazebo.
	$(BIN)/python -m misstep.robot.gazebo.build

clean:  ## Remove the environment and all outputs.
	rm -rf $(VENV) out site .mypy_cache .pytest_cache .ruff_cache .hypothesis
