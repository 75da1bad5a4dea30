# `make demo` and `make test` are all that a newcomer needs; both make .venv first. `make check` is what main must pass.
PYTHON ?= python3.11
VENV := .venv/bin/python

.PHONY: demo test check search newest lint contracts docs extension release clean

demo: .venv/ready
	$(VENV) demo/run.py

# Three workers for two cores, since many tests wait for windows and processes; a file's tests stay together, so that
# its fixtures are made once. The order of the files is that of tests/conftest.py: xdist's own puts those with the most
# tests first, and the longest have few. UTF-8, because bpy resets the locale.
PYTEST := PYTHONUTF8=1 $(VENV) -m pytest tests --numprocesses 3 --dist loadfile --no-loadscope-reorder

# The quick tests: the engine's packages and one Blender version.
test: .venv/ready
	$(PYTEST) -m "quick and not search"
	@echo "Left out: whole runs, other Blender versions, hard cases, other programs. 'make check' runs them."

check: lint contracts docs extension
	$(PYTEST)

# Wide random searches, and what other Blender versions repeat.
search: .venv/ready
	$(PYTEST) -m search

# The quick tests of the engine with the newest packages that requirements.txt allows, in Python 3.11 and 3.13.
newest:
	.ci/newest

lint: .venv/ready
	$(VENV) -m ruff check .
	$(VENV) -m ruff format --check .
	$(VENV) .ci/typecheck.py

# Which package may import which (.importlinter).
contracts: .venv/ready
	$(VENV) .ci/contracts.py

# The documentation: what is made from results and code must be current; the site goes to site/.
docs: .venv/ready
	$(VENV) docs/scripts/tables.py --check
	$(VENV) docs/scripts/import_diagram.py --check
	$(VENV) docs/scripts/command_line.py --check
	NO_MKDOCS_2_WARNING=1 $(VENV) -m mkdocs build --strict --quiet --site-dir site

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
	rm -rf .venv dist site demo/output swag_engine/kernels/lib
