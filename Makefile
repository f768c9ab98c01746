# What each target does: make help. All of them set up what they need themselves.

BUS ?=
CASES ?= 120
FIRST ?= 100240
PYTHON_IN_VENV := .venv/bin/python
VALIDATED := $(addprefix replay_logs/,calibration/ride_000.blf turning/city_11C.mcap city_14C.blf calibration/ride_003.blf \
    calibration/ride_004.blf turning/oval_2C.blf calibration/ride_006.blf calibration/ride_007.blf city_34C.blf \
    validation/dyno_00.blf calibration/dyno_02.blf)
FAST := $(addprefix tests/,can estimator model recording routes test_bad_input.py test_docs.py test_errors.py \
    test_options.py test_requirements.py test_state.py test_structure.py test_toml.py test_units.py test_vehicle.py)

.PHONY: help setup run test check lint format docs man deb deb-clean-root bench trial range-benchmark validation hardening mutants clean
.DEFAULT_GOAL := help

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*##/\1:/p' $(MAKEFILE_LIST) | awk -F: '{printf "make %-16s%s\n", $$1, $$2}'

setup: .venv/.ready  ## virtual environment .venv with the pinned dependencies

.venv/.ready: pyproject.toml .ci/requirements.txt .ci/setup
	@.ci/setup venv

run: setup  ## a recorded full discharge with its range, the end live on a CAN bus; then a hidden loss found in three rides
	@bus=$(BUS); [ "$$bus" ] || { .ci/setup vcan && bus=vcan || bus=virtual; }; $(PYTHON_IN_VENV) replay_logs/demo.py --bus $$bus

test: setup  ## every test, on the host, on a real vcan and under systemd
	@.ci/test

check: lint  ## ruff, mypy and the tests that take no guest, browser or long ride (2 minutes)
	$(PYTHON_IN_VENV) -m pytest -q -n auto --dist worksteal $(FAST) $(addprefix --ignore=tests/estimator/test_,life.py silence.py weakest.py)

lint: setup  ## ruff and mypy
	$(PYTHON_IN_VENV) -m ruff check .
	$(PYTHON_IN_VENV) -m ruff format --check .
	$(PYTHON_IN_VENV) -m mypy

format: setup  ## let ruff format the code
	$(PYTHON_IN_VENV) -m ruff check --fix .
	$(PYTHON_IN_VENV) -m ruff format .

docs: setup .venv/.docs-ready  ## the documentation as a site in build/docs; a dead link or any other warning is an error
	$(PYTHON_IN_VENV) -m sphinx --builder html --fresh-env --fail-on-warning --keep-going --quiet docs build/docs

man: setup  ## the manual page and the completions of bash and zsh, in build/shell
	$(PYTHON_IN_VENV) docs/shell.py build/shell

deb: setup  ## a Debian package of the daemon for machines like this one, in dist/
	$(PYTHON_IN_VENV) packaging/debian/build.py dist

deb-clean-root: setup  ## the package's life on a minimal Debian in a guest, from installation to purge (3 minutes)
	.ci/setup root
	.ci/setup service
	GZ_ONBOARD_CLEAN_ROOT=build/clean-root.ext4 $(PYTHON_IN_VENV) -m pytest -n 0 tests/clean_root

.venv/.docs-ready: .venv/.ready .ci/requirements-docs.txt
	@.ci/setup docs

bench: setup  ## cost per frame, start-up, memory, next to the plain pipeline; rewrites docs/results/benchmarks.md (AGAINST=commit)
	$(PYTHON_IN_VENV) -m benchmarks.bench --page docs/results/benchmarks.md $(if $(AGAINST),--against $(AGAINST))

trial: setup  ## does discover name hidden effects in rides of a scooter that is not the model's? rewrites docs/results/trial.md (CASES=n FIRST=seed)
	$(PYTHON_IN_VENV) -m benchmarks.trial --cases $(CASES) --first $(FIRST)

range-benchmark: setup  ## how good is the range on full discharges of scooters that are not the model's? rewrites docs/results/range-benchmark.md
	$(PYTHON_IN_VENV) -m benchmarks.range_benchmark

validation: setup  ## the recorded rides of the repository against their simulation; rewrites docs/results/validation.md
	$(PYTHON_IN_VENV) -m gz_onboard validate $(VALIDATED) --output build/validation --markdown docs/results/validation.md
	cp build/validation/oval_2C.validation.png docs/images/validation_oval.png

hardening: setup  ## hostile frames, sensors that lie, power cuts, damaged states, malformed files by the thousand; rewrites docs/results/reliability.md
	$(PYTHON_IN_VENV) -m tests.hardening

mutants: setup  ## 300 wrong lines, one at a time: do the tests notice each?
	$(PYTHON_IN_VENV) -m tests.mutants

clean:  ## remove what the other targets made, except runs/
	rm -rf .venv build dist docs/api docs/generated .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
