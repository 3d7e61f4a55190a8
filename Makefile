# SPDX-License-Identifier: Apache-2.0
# Every target sets itself up: `make demo` or `make test` in a fresh clone is enough. Arguments: make demo ARGS="--scenario circle".

BIN := .venv/bin
READY := .venv/ready
UV := $(shell command -v uv)

# The first Python of 3.11 to 3.14 that starts: for these every pinned package has a wheel.
FITS := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))
PYTHON = $(shell for python in python3 python3.13 python3.12 python3.11 python3.14; do $$python -c '$(FITS)' 2>/dev/null && echo $$python && break; done)

# Tests start hundreds of processes: where an image forbids it, each would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-busy test-slow soak attack ends kills problems bench lint format types docs gallery msg lock clean

demo: $(READY)
	$(BIN)/rti-mpc demo $(ARGS)

test: $(READY)
	$(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder $(ARGS)

test-busy: $(READY)
	$(BIN)/python tests/busy.py $(ARGS)

test-slow: $(READY)
	$(BIN)/pytest -m slow $(ARGS)

soak: $(READY)
	MALLOC_ARENA_MAX=2 $(BIN)/pytest -m slow -s tests/processes/test_soak.py --soak-s 1800 $(ARGS)

attack: $(READY)
	$(BIN)/pytest -m slow -s tests/processes/test_attack.py --attack 1000000 $(ARGS)

ends: $(READY)
	$(BIN)/pytest -m slow -s tests/processes/test_ends.py --ends 50 $(ARGS)

kills: $(READY)
	$(BIN)/pytest -m slow -s tests/processes/test_record.py --kills 50 $(ARGS)

problems: $(READY)
	$(BIN)/pytest -s tests/rti/test_random_problems.py --structures 300 --sets 34 $(ARGS)

bench: $(READY)
	$(BIN)/pytest -m benchmark -s $(ARGS)

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check

format: $(READY)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

types: $(READY)
	$(BIN)/mypy

docs: $(READY)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement docs/requirements.txt
	NO_MKDOCS_2_WARNING=1 $(BIN)/properdocs build --quiet

gallery: $(READY)
	$(BIN)/python docs/gallery.py $(ARGS)

msg: $(READY)
	$(BIN)/python -m rti_mpc.wire.msg deploy/msg

lock:
	$(if $(UV),,$(error make lock needs uv: pip install uv))
	uv pip compile --quiet --no-config --upgrade --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate \
		--custom-compile-command "make lock" --extra view --extra figure --extra certs --extra record --extra tune --group dev --output-file constraints.txt pyproject.toml
	uv pip compile --quiet --no-config --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate \
		--custom-compile-command "make lock" --group docs --constraint constraints.txt --output-file docs/requirements.txt pyproject.toml

clean:
	rm -rf .venv site .mypy_cache .pytest_cache .ruff_cache dist

ifdef UV
$(READY): constraints.txt pyproject.toml
	@echo "setting up .venv with uv"
	@rm -rf .venv && uv venv --quiet --python '$(or $(PYTHON),>=3.11,<3.15)' .venv
	@uv pip install --quiet --python $(BIN)/python --require-hashes --requirement constraints.txt
	@uv pip install --quiet --python $(BIN)/python --no-build-isolation --no-deps --editable .
	@touch $@
else
$(READY): constraints.txt pyproject.toml
	@test -n "$(PYTHON)" || { echo "make needs Python 3.11 to 3.14: apt-get install python3 python3-venv" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "make needs venv: apt-get install $$(basename $(PYTHON))-venv" >&2; exit 1; }
	@echo "setting up .venv with pip and $$($(PYTHON) --version), about a minute"
	@rm -rf .venv && $(PYTHON) -m venv .venv
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-compile --require-hashes --requirement constraints.txt
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --editable .
	@touch $@
endif
