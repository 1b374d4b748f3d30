# On a fresh machine with Python >= 3.11, pip and make, every target sets itself up first.
PYTHON ?= python3
# As the command has it: matrices are many and small.
export OPENBLAS_NUM_THREADS ?= 1
BIN := .venv/bin
INSTALLED := .venv/.installed

.PHONY: oldest golden robots-check robots-given bench-robot sequences robots-models bench-long gap-results blind-check real wrist readme-figures bench bench-haptic bench-watch help setup demo test lint typecheck tests slow wheel docs constants results paper check-gap calibrate fuzz gap-labs gap-fresh

help:  ## show this list
	@sed -n 's/^\([a-z-]*\):.*##/\1\t/p' $(MAKEFILE_LIST) | expand -t 12

setup: $(INSTALLED)  ## make .venv with the project and its tools in it

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "Python >= 3.11 is needed")'
	$(PYTHON) -m venv .venv

# The demo needs the package alone, not the tools of its developers.
PACKAGE := .venv/.package
$(PACKAGE): pyproject.toml | $(BIN)/python
	test -e $(INSTALLED) || $(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(INSTALLED): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable '.[dev]'
	touch $(PACKAGE) $@

demo: $(PACKAGE)  ## identify and diagnose the recording that comes along; figures in demo/
	$(BIN)/hmmseg demo --figures demo

test: lint typecheck tests  ## all checks: style, types, tests

lint: $(INSTALLED)  ## style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

typecheck: $(INSTALLED)  ## static types
	$(BIN)/mypy

tests: $(INSTALLED)  ## tests alone, without those marked slow
	$(BIN)/pytest -n auto --dist loadfile tests

slow: $(INSTALLED)  ## the tests marked slow, and every call's annotations checked
	CHECK_CALLS=1 $(BIN)/pytest -n auto --dist loadfile -m slow tests

golden: $(INSTALLED)  ## verdicts, boundaries and properties of recordings/ against those pinned in tests/data/golden
	$(BIN)/python -m experiments.golden compare

# Both ends of what pyproject.toml declares, each in an environment of its own; ArviZ 1 needs Python 3.12,
# which NEWEST_PYTHON can name.
NEWEST_PYTHON ?= $(BIN)/python
wheel: $(INSTALLED)  ## build sdist and wheel, use it outside the repository with the newest versions there are
	$(BIN)/python .ci/check_wheel.py --python $(NEWEST_PYTHON)

OLDEST := build/oldest
oldest: $(INSTALLED)  ## the demo and the file formats with the oldest versions that pyproject.toml declares
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(OLDEST)
	$(BIN)/uv pip install --quiet --python $(OLDEST) --resolution lowest-direct '.[mujoco,files]' 'pytest>=8'
	$(OLDEST)/bin/hmmseg doctor
	$(OLDEST)/bin/hmmseg demo --quiet --figures build/oldest_demo
	$(OLDEST)/bin/python -m pytest -q -W default -p no:cacheprovider tests/hmmseg/test_formats.py

docs: $(INSTALLED)  ## the documentation site, in build/docs; warnings are errors
	$(BIN)/sphinx-build -q -E -W --keep-going -b html docs build/docs

constants: $(INSTALLED)  ## docs/tables/constants.csv: every numeric constant with its kind and reason
	$(BIN)/python -m experiments.constants

bench: $(INSTALLED)  ## time of the commands, stage by stage; fills docs/benchmarks.md
	$(BIN)/python -m experiments.benchmarks.commands recordings/paper_blocks
	$(BIN)/python -m experiments.write_tables

bench-watch: $(INSTALLED)  ## following a task while it runs, on RECORDINGS; fills docs/watch.md
	$(BIN)/python -m experiments.benchmarks.watch $(or $(RECORDINGS),recordings)
	$(BIN)/python -m experiments.write_tables

bench-long: $(INSTALLED)  ## up to 10,000,000 rows of a repeated task of the LAB, segmented from disk; fills docs/benchmarks.md
	$(BIN)/python -m experiments.benchmarks.long_recordings $(or $(LAB),recordings/none_1)
	$(BIN)/python -m experiments.write_tables

bench-haptic: $(INSTALLED)  ## a minute of the virtual model at 4 kHz beside loops that do nothing (real-time priority: as root); fills docs/virtual_model.md
	$(BIN)/python -m experiments.benchmarks.haptic_loop --seconds 60 --realtime
	$(BIN)/python -m experiments.write_tables

gap-results: $(INSTALLED)  ## diagnoses of the labelled RECORDINGS; fills docs/gap_results.md
	$(BIN)/python -m experiments.gap_recordings $(or $(RECORDINGS),recordings)
	$(BIN)/python -m experiments.write_tables

gap-labs: $(INSTALLED)  ## diagnoses of open labs in the folder LABS; fills docs/gap_results.md
	$(BIN)/python -m experiments.gap_drawn $(or $(LABS),../shared/recordings_labs) --results build/gap_labs --run "this code"
	$(BIN)/python -m experiments.write_tables

FRESH := experiments/results/gap_fresh.json
DRAWN := $(BIN)/python -m experiments.gap_drawn --results build/gap_fresh --output $(FRESH)
gap-fresh: $(INSTALLED)  ## diagnoses of labs of our own second simulator, drawn anew; fills docs/gap_results.md
	set -e; open() { $(BIN)/python -m experiments.blind_check open --seed $$1 --cases $$2 --out build/$$1 --tiers $$3; }; \
	  open 273301 20 healthy; open 273311 40 "single pair outside"
	$(DRAWN) build/273301 build/273311 --run "judged once"
	$(BIN)/python -m experiments.write_tables

blind-check: $(INSTALLED)  ## diagnose the SET of the second simulator (a folder with cases and seal) and score it; fills docs/gap_results.md
	$(BIN)/python -m experiments.blind_check diagnose --cases $(SET)/cases --out $(SET)/results
	$(BIN)/python -m experiments.blind_check score --sealed $(SET) --results $(SET)/results --json experiments/results/blind_check.json
	$(BIN)/python -m paper_figs gap_reliability
	$(BIN)/python -m experiments.write_tables

sts3215: $(INSTALLED)  ## what changed of a servo, on labelled logs in the folder SET; fills docs/robots_results.md
	$(BIN)/python -m experiments.real.sts3215 $(SET) --cases 4 --seed 4 --output experiments/results/sts3215.json
	$(BIN)/python -m experiments.real.bam $(SET) --output experiments/results/sts3215_bam.json
	$(BIN)/python -m experiments.write_tables

REAL := $(or $(RECORDINGS),../shared/real)
real: $(INSTALLED)  ## recordings of real robots, in folders of RECORDINGS; fills docs/results.md, draws their figures
	$(BIN)/python -m experiments.real.hiro_snap $(REAL)/hiro_snap
	$(BIN)/python -m experiments.real.robot_gap $(REAL)/xl330_pendulum --figures docs/figures
	$(BIN)/python -m experiments.real.xl330_sheet $(REAL)/xl330_pendulum --diagnose --output experiments/results/xl330_sheet.json
	$(BIN)/python -m experiments.write_tables

wrist: $(INSTALLED)  ## grippers with a sensor in the wrist, of RECORDINGS and of our own; the figures of docs/wrist.md
	$(BIN)/python -m experiments.wrist $(RECORDINGS)

readme-figures: $(INSTALLED)  ## the README's pictures, with a scripted session of hmmseg play (needs Chromium)
	$(BIN)/python -m experiments.readme_figures $(LOGS)
	$(BIN)/python -m experiments.play_session build/played --gif docs/figures/play.gif

results: $(INSTALLED)  ## scores, calibration and benchmarks; fills the tables of README and docs/
	$(BIN)/python -m experiments.score_recordings recordings
	$(BIN)/python -m experiments.calibration recordings
	$(BIN)/python -m experiments.write_tables

ROBOTS := build/robots
robots-models: $(INSTALLED)  ## models of robots by others out of packages, in build/robots, for experiments.robots_check
	$(BIN)/python -m pip download --quiet --disable-pip-version-check --no-deps --only-binary :all: -d $(ROBOTS) dm-control robosuite
	cd $(ROBOTS) && for wheel in *.whl; do ../../$(BIN)/python -m zipfile -e $$wheel .; done

robots-check: robots-models  ## seeded faults in these models, diagnosed (in build/robots_check; resumable) and scored; fills docs/robots_results.md
	$(BIN)/python -m experiments.robots_check $(ROBOTS) --seed 58210616 --cases 40 --robots pendulum reacher acrobot --out build/robots_check
	$(BIN)/python -m experiments.robots_check $(ROBOTS) --score build/robots_check
	$(BIN)/python -m experiments.write_tables

robots-given: $(INSTALLED)  ## faulty robots of another generator, in the folder SET, diagnosed and scored; fills docs/robots_results.md
	$(BIN)/python -m experiments.robots_check.given $(or $(SET),../shared/robots_check)
	$(BIN)/python -m experiments.write_tables

bench-robot: robots-models  ## time of a diagnosis of a minute of an arm of six joints; fills docs/robots_results.md
	$(BIN)/python -m experiments.benchmarks.robot $(ROBOTS)
	$(BIN)/python -m experiments.write_tables

calibrate: $(INSTALLED)  ## do intervals hold: ranks of 1,000 data sets, worlds that differ; resumable
	$(BIN)/python -m experiments.sbc
	$(BIN)/python -m experiments.calibration_worlds
	$(BIN)/python -m experiments.write_tables

sequences: $(INSTALLED)  ## are readings without labels honest, what does one label do? REAL, PANDA, HANDS: folders; fills docs/sequences.md
	$(BIN)/python -m experiments.sequences check $(if $(REAL),--real $(REAL)) $(if $(PANDA),--panda $(PANDA)) $(if $(HANDS),--hands $(HANDS))
	$(BIN)/python -m experiments.write_tables

paper: $(INSTALLED)  ## the paper's tables and figures; fills docs/reproduction.md
	$(BIN)/python -m experiments.paper
	$(BIN)/python -m paper_figs
	$(BIN)/python -m experiments.paper.write_docs

CHECKED := build/check_gap
SEALED := experiments/blind_check/sealed_small
check-gap: $(INSTALLED)  ## diagnose a small sealed set of another simulator's recordings and score it
	rm -rf $(CHECKED)
	$(BIN)/python -m experiments.blind_check diagnose --cases $(SEALED)/cases --out $(CHECKED)
	$(BIN)/python -m experiments.blind_check score --sealed $(SEALED) --results $(CHECKED) --json $(CHECKED)/score.json

fuzz: $(INSTALLED)  ## 100,000 damaged files through every reader and command, in process (some minutes)
	PYTHONPATH=tests $(BIN)/python -m experiments.fuzz --cases 100000 --keep build/fuzz
