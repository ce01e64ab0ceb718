# Each target is one command, from nothing: `make demo` on a fresh clone builds the environment first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
WORKERS ?= $(shell $(PYTHON) -c "import os; print((os.cpu_count() or 1) + 1)")
TORCH := $(shell sed -n 's/^\(torch==.*\)/\1/p' constraints.txt)

.DEFAULT_GOAL := help
.PHONY: help setup demo walkthrough repro site test test-all test-fast explore lint kit bench faults wheel cuda sass emulate gpu-check docs-check clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile | expand -t 20

setup: $(STAMP)  ## make .venv, install everything into it, compile the CPU kernels where there is a C++ compiler
	@$(BIN)/python -m pop_fast.compiled.build --if-possible

# torch goes first and by exact version: left to the resolver, pip picks the newest build and its gigabytes of CUDA.
$(STAMP): pyproject.toml pop_ref/pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(TORCH)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ./pop_ref -e '.[dev]'
	@touch $@
	@echo "pop is $(BIN)/pop; 'source $(BIN)/activate' puts it on the path"

demo: setup  ## write the demo capture, train POP on it, leave report.html, PLY, renders and metrics in out/demo
	$(BIN)/pop demo out/demo_capture --overwrite
	$(BIN)/pop train out/demo_capture --out out/demo --minutes 1.25 --overwrite
	@echo "open out/demo/report.html"

walkthrough: setup  ## run the chapters and write pages, notebooks, slides and (with a Chromium) a PDF to out/walkthrough
	$(BIN)/python -m pop_ref.walkthrough out/walkthrough --all

repro: setup  ## train every row of the paper at toy scale (minutes), leave its tables and figures in out/repro
	$(BIN)/pop-repro queue --scale toy --results out/repro/results --work out/repro/work
	for table in 1 2 3 4 5 beyond; do \
		$(BIN)/pop-repro table $$table --scale toy --results out/repro/results --out out/repro || exit 1; done
	for figure in 1 2 3 4a 4b 5 6a 6b 7; do $(BIN)/pop-repro figure $$figure --scale toy --results out/repro/results \
		--work out/repro/work --out out/repro || exit 1; done

site: demo walkthrough  ## build docs/, the walk-through and the demo's report as one site into out/site
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[docs]'
	$(BIN)/mkdocs build --strict --quiet
	mkdir -p out/site/demo && cp out/demo/report.html out/site/demo/
	@echo "open out/site/index.html"

# workers with one thread each: two that take both cores wait for each other. One more than there are cores, since some
# tests wait for browsers and for processes of their own; those are many, and read what the first of them compiled
TESTS := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

test: setup  ## run the tests; slow ones and those that rehearse jobs for GPU nodes are left to test-all
	$(TESTS) -m "not rehearsal and not slow"

test-all: setup  ## run every test
	$(TESTS)

# float64 of the torch path stands for that of the compiled one; what failed last comes first
test-fast: setup  ## run in two minutes what a change most likely breaks: renderers, gradients, laws (5 examples), steps
	HYPOTHESIS_PROFILE=quick $(TESTS) -q --failed-first \
		-m "not slow" -k "not compiled64" tests/fast tests/gradients tests/golden tests/laws tests/oracle tests/train \
		tests/meta/test_architecture.py

explore: setup  ## run the tests that draw examples with fresh ones, once for each of SEEDS="1 2 3"
	@broken=; for seed in $(or $(SEEDS),$$(date +%s)); do \
		HYPOTHESIS_PROFILE=explore $(BIN)/python -m pytest -q -m hypothesis --hypothesis-seed=$$seed || broken="$$broken $$seed"; \
	done; test -z "$$broken" || { echo "broken with --hypothesis-seed:$$broken"; exit 1; }

lint: setup  ## ruff (rules and format) and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

faults: setup  ## damaged files, kills, crashes, full disks, sanitizers (MINUTES=10), then large captures
	$(BIN)/python -m benchmarks.faults --minutes $(or $(MINUTES),10)
	$(BIN)/python -m benchmarks.load

# hours of one core: every mutant in each precision, every line of the oracle that laws run
kit: setup  ## measure the kit (kills, teeth, what laws and vectors reach) and write docs/kit.md's tables
	$(BIN)/python -m pop_ref.conformance.mutants --json benchmarks/results/kills.json
	$(BIN)/python -m pop_ref.conformance.teeth benchmarks/results/teeth.json
	$(BIN)/python -m pop_ref.conformance.law_coverage benchmarks/results/law_coverage.json
	$(BIN)/python -m pop_ref.conformance.vector_kills benchmarks/results/vector_kills.json
	$(BIN)/python docs/tables.py --write

bench: setup  ## check the fast path against the oracle, then time it
	$(BIN)/python benchmarks/run.py

# without --wheel, so that a wheel is built from the sdist beside it, which is what others build from
wheel: setup  ## build both distributions into dist/, pop-splatting's with compiled kernels (needs a C++ compiler)
	$(BIN)/python -m build --outdir dist pop_ref
	POP_WHEEL_KERNELS=1 $(BIN)/python -m build --outdir dist .

cuda: setup  ## compile the CUDA extension (needs nvcc; no GPU)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[cuda-build]'
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m cuda_ext.build

sass: setup  ## count the kernels' machine instructions into benchmarks (needs nvcc; no GPU)
	$(BIN)/python -m pip install --quiet -e '.[sass]'
	$(BIN)/python -m cuda_ext.machine_code.count_sass --json benchmarks/results/sass.json
	$(BIN)/python benchmarks/gpu_predictions.py --write

emulate: setup  ## run the CUDA kernels' own source on the host, warp by warp: every law, training steps (minutes)
	POP_CUDA_ON=emulated POP_EMULATED_LAWS=1 POP_CUDA_KINDS="pixel_parallel atomics gaussian_parallel" \
		$(BIN)/python -m pytest -q tests/cuda/gpu tests/cuda/emulated

# no environment is made and nothing installed: it runs on a node with a GPU, torch and nvcc, and writes to $$OUT
gpu-check:  ## JOB=1: build, smoke, times; 2: laws, steps, training on CAPTURES="a b"; 3: rows; 4: several GPUs (needs a GPU)
	$(PYTHON) -m cuda_ext.gpu_check $(if $(JOB),--job $(JOB)) $(if $(STAGES),--stages $(STAGES)) \
		$(if $(CAPTURES),--captures $(CAPTURES))

docs-check: setup  ## fail when a table, name, path or command in README.md is no longer true
	$(BIN)/python -m pytest -q tests/meta/test_readme.py
	$(BIN)/python -m pytest -q --doctest-modules pop_ref --ignore pop_ref/walkthrough

clean:  ## remove what was built here; .venv stays
	rm -rf out build dist .pytest_cache .ruff_cache .hypothesis htmlcov .coverage
	rm -rf pop_fast/compiled/_*.so cuda_ext/build tests/cuda/emulated/build benchmarks/faults/corpus
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
