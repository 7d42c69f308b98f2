# Needs Linux, make and Python 3.11, 3.12 or 3.13 with venv and pip; everything else goes into .venv.
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-slow test-pythons test-lowest test-clients fuzz check format bench docs pretrained wheel clean

VERSIONS := 3.11 3.12 3.13
SUITABLE := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
VERSION := import sys; print('%d.%d' % sys.version_info[:2])
first_suitable = $(firstword $(foreach p,$(1),$(shell $(p) -c "$(SUITABLE)" 2>/dev/null && echo $(p))))
# Interpreters of one version beside those on PATH: pyenv and uv keep them.
kept = $(wildcard $(HOME)/.pyenv/versions/$(1).*/bin/python $(HOME)/.local/share/uv/python/cpython-$(1).*/bin/python)
PYTHON ?= $(call first_suitable,python3.11 python3 python3.12 python3.13 $(foreach v,$(VERSIONS),$(call kept,$(v))))
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
RUN := $(BIN)/marl-handover
WORKERS ?= 2
# Each worker has a run of neighbouring tests, whose fixtures it makes once, and takes over some of the other's when it is through.
PYTEST := -m pytest -q -n $(WORKERS) --dist worksteal
# Two workers on two cores: let no numerical library start threads of its own in each.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

help:
	@echo "make demo       install, train a supervisor, evaluate it against the exact planner, leave pictures in runs/"
	@echo "make test       install and run the tests; make test-slow the slow ones (wheel, SIGKILL, longer learners)"
	@echo "make test-pythons the tests with every other Python that fits and is here; TESTS=tests/cell names some of them"
	@echo "make fuzz       20,000 random command lines over every key of every command, in one process (an hour or two)"
	@echo "make test-lowest the tests with the lowest versions that pyproject.toml allows, in .venv-lowest"
	@echo "make test-clients other people's programs drive the emulated bus servos, in .venv-clients"
	@echo "make check      style, types and import layers; make format repairs the style"
	@echo "make bench      measure motion planning, the safety gate, speed, and learning against Stable-Baselines3 (hours)"
	@echo "make docs       build the documentation site into site/; warnings are errors"
	@echo "make pretrained train the four policies that are shipped"
	@echo "make wheel      build a wheel into dist/"

$(STAMP): pyproject.toml constraints.txt
	@if [ -z "$(PYTHON)" ]; then echo "make: Python 3.11, 3.12 or 3.13 with venv and pip is needed; install it (apt install python3-venv) or name it: make PYTHON=/path/to/python3.12" >&2; exit 2; fi
	@$(PYTHON) -c "$(SUITABLE)" 2>/dev/null || { echo "make: $(PYTHON) is $$($(PYTHON) -V 2>/dev/null || echo no Python), not 3.11, 3.12 or 3.13 with venv and pip; name another: make PYTHON=/path/to/python3.12" >&2; exit 2; }
	@test -x $(BIN)/python && $(BIN)/python -c "$(SUITABLE)" 2>/dev/null || $(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $@

demo: $(STAMP)
	rm -rf runs/demo
	$(RUN) train preset=epsilon_5deg out=runs/demo
	$(RUN) evaluate policy=runs/demo episodes=10000 json=runs/demo/evaluation.json
	$(RUN) evaluate policy=exact episodes=10000 json=runs/demo/exact.json
	$(RUN) workspace out=runs/demo
	$(RUN) plot kind=run run=runs/demo
	-@$(BIN)/python scripts/expected_range.py runs/demo/evaluation.json epsilon_5deg
	@echo "The run, its evaluation and the pictures are in runs/demo"

test: $(STAMP)
	$(ONE_THREAD) $(BIN)/python $(PYTEST) $(TESTS)

# Each in an environment of its own beside .venv, whose Python is left to "make test".
test-pythons: $(STAMP)
	$(foreach v,$(filter-out $(shell $(BIN)/python -c "$(VERSION)"),$(VERSIONS)),$(call test_with,$(v),$(call first_suitable,python$(v) $(call kept,$(v)))))

define test_with
$(if $(2),$(MAKE) test VENV=.venv-$(1) PYTHON=$(2),@echo "make: no Python $(1) here, so nothing is tested with it")

endef

test-slow: $(STAMP)
	$(ONE_THREAD) $(BIN)/python $(PYTEST) --timeout 1800 -m "slow and not gpu and not hardware and not clients"

# Programs that others wrote for bus servos drive the emulated ones; two of them have one import name.
CLIENTS := vendor=ftservo-python-sdk==2.0.1 lerobot_sdk=feetech-servo-sdk==1.0.0 rustypot=rustypot==1.13.1
name_of = $(word 1,$(subst =, ,$(1)))

test-clients: $(STAMP)
	$(foreach c,$(CLIENTS),$(BIN)/python -m venv --clear .venv-clients/$(call name_of,$(c)) && .venv-clients/$(call name_of,$(c))/bin/python -m pip install --quiet --disable-pip-version-check pyserial $(patsubst $(call name_of,$(c))=%,%,$(c)) &&) true
	$(ONE_THREAD) $(BIN)/python -m pytest -q -m clients tests/hardware/test_emulate_servos.py

fuzz: $(STAMP)
	$(ONE_THREAD) $(BIN)/python tests/fuzz_command_lines.py 20000

# Every lower bound of pyproject.toml at once; UV_TORCH_BACKEND=cpu spares a CUDA build where PyTorch's own index can be reached.
test-lowest:
	$(PYTHON) -m venv --clear .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet --disable-pip-version-check uv
	.venv-lowest/bin/uv pip install --quiet --python .venv-lowest/bin/python --resolution lowest-direct -e ".[dev,peers,ompl]"
	$(ONE_THREAD) .venv-lowest/bin/python $(PYTEST)

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev,peers,ompl]"
	$(BIN)/python bench/motion.py
	$(BIN)/python bench/safety_filter.py commands=10000
	$(BIN)/python bench/run.py

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "The site is in site/; python -m http.server --directory site shows it"

# The policies that travel in the wheel; see the origin stored in each file.
pretrained: $(STAMP)
	$(RUN) train preset=pretrained architecture=A out=runs/pretrained_a
	$(BIN)/python scripts/export_policy.py runs/pretrained_a marl_handover/pretrained/a.npz
	$(RUN) train preset=pretrained architecture=B out=runs/pretrained_b
	$(BIN)/python scripts/export_policy.py runs/pretrained_b marl_handover/pretrained/b.npz
	$(RUN) train preset=twin architecture=B out=runs/pretrained_twin
	$(BIN)/python scripts/export_policy.py runs/pretrained_twin marl_handover/pretrained/twin.npz
	$(RUN) train preset=any_cell out=runs/pretrained_any
	$(BIN)/python scripts/export_policy.py runs/pretrained_any marl_handover/pretrained/any.npz

wheel: $(STAMP)
	$(BIN)/python -m build --wheel --outdir dist .

clean:
	rm -rf .venv .venv-* build dist site .pytest_cache .ruff_cache .mypy_cache .hypothesis .import_linter_cache
