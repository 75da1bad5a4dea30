# `make demo` and `make test` are all that a newcomer needs; both make .venv first.
PYTHON ?= python3.11
VENV := .venv/bin/python

.PHONY: demo test lint extension release clean

demo: .venv/ready
	$(VENV) demo/run.py

test: .venv/ready
	$(VENV) -m pytest tests

lint: .venv/ready
	$(VENV) -m ruff check .
	$(VENV) -m ruff format --check .
	$(VENV) -m mypy

# The extension's zip, with the kernels of this machine or of every platform.
extension: .venv/ready
	$(VENV) .ci/build_extension.py

release: .venv/ready
	$(VENV) -m swag_engine.kernels.build --all
	$(VENV) .ci/build_extension.py

# The stamp changes when a pin or a kernel does, so that a second run starts at once.
.venv/ready: constraints.txt requirements.txt requirements-dev.txt environment.sh $(wildcard swag_engine/kernels/*.*)
	PYTHON=$(PYTHON) sh environment.sh
	touch $@

clean:
	rm -rf .venv dist demo/output swag_engine/kernels/lib
