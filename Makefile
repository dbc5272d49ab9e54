# Each target sets up what it needs by itself and is quick the second time.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
G2ARD_DATA ?= $(abspath ../shared/data)
export G2ARD_DATA
export PIP_DISABLE_PIP_VERSION_CHECK = 1

RUST := $(shell find rust -name '*.rs' -o -name '*.wgsl' -o -name Cargo.toml) Cargo.toml Cargo.lock

.PHONY: demo test test-benchmarks test-fresh lint docs printed stress fuzz fuzz-guided miri bench wheel wheel-linux ends release-check setup clean

setup: $(VENV)/.built

# One stamp for both halves: Python dependencies by pyproject.toml, the extension by cargo.
$(VENV)/.built: pyproject.toml $(RUST) | $(VENV)/.maturin
	$(BIN)/maturin develop --release --extras dev --quiet
	touch $@

$(VENV)/.maturin:
	test -x $(BIN)/maturin || { $(PYTHON) -m venv $(VENV) && $(BIN)/pip install --quiet "maturin>=1.9,<2"; }
	touch $@

# The package as the demo needs it: without torch, what the tests need, and the GPU kernels.
$(VENV)/.plain: pyproject.toml $(RUST) | $(VENV)/.maturin
	$(BIN)/maturin develop --release --no-default-features --quiet
	touch $@

# A development build that exists is kept up to date instead of replaced.
demo: $(if $(wildcard $(VENV)/.built),setup,$(VENV)/.plain)
	$(BIN)/python examples/01_distill_a_scene.py

# Python's tests run in TEST_PROCESSES processes (0: in one), each with two threads for the kernels. Tests of determinism set
# their own number of threads.
TEST_PROCESSES ?= 2
PYTEST = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 RAYON_NUM_THREADS=2 $(BIN)/python -m pytest --numprocesses $(TEST_PROCESSES) --dist loadfile
test: setup
	cargo test --quiet --workspace --profile bench
	$(PYTEST)

# The tests of studies, which `make test` skips. `.ci/run` runs them where the last commit changed one, and nightly.yml always.
test-benchmarks: setup
	$(PYTEST) tests/benchmarks

# The part of `make test` that needs what a fresh machine has not (ffmpeg, an adapter, a browser, Node packages): it skips there.
# With `-p g2ard-gpu`, cargo would compile wgpu once more, for other features of what it depends on.
test-fresh: setup
	cargo test --quiet --profile bench --workspace --exclude g2ard-core
	$(BIN)/python tests/machines.py without

# What the documentation prints, against what the program prints; `tests/printed.py record` writes it anew.
printed: setup
	$(BIN)/python tests/printed.py compare

# Over 10,000 random gradient cases; a slice of them is in `make test`.
stress: setup
	$(BIN)/python tests/stress/run.py

# Malformed files for every reader, and FUZZ_RUNS mutated ones; a slice of both is in `make test`.
FUZZ_RUNS ?= 2000
FUZZ_SEED ?= 1
fuzz: setup
	$(BIN)/python tests/fuzz_readers.py --runs $(FUZZ_RUNS) --seed $(FUZZ_SEED)

# The same readers, by libFuzzer, which looks for files that reach new lines: FUZZ_SECONDS of each of the corpus.
FUZZ_SECONDS ?= 60
fuzz-guided: setup
	$(BIN)/pip install --quiet atheris
	$(BIN)/python tests/fuzz_guided.py --seconds $(FUZZ_SECONDS) --seed $(FUZZ_SEED)

lint: setup
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --quiet -- -D warnings
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python tests/nodes.py
	$(BIN)/python tests/relayed.py

# The site, in site/docs/index.html. A broken link or reference is an error.
EXTRA_DOCS := import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"])
$(VENV)/.docs: pyproject.toml
	$(BIN)/pip install --quiet $$($(BIN)/python -c '$(EXTRA_DOCS)')
	touch $@

docs: setup $(VENV)/.docs
	$(BIN)/python -m sphinx -q -E -a -W --keep-going -c docs -b html . site
	@echo site/docs/index.html

# Needs a scene of at least 300,000 Gaussians: SCENE=path, or real data. Studies run small: one ratio, few steps, generated or
# small scenes; expect an hour. What bench/ holds is not measured again; `make clean` removes it.
STUDIES := ablations bounded chain compression geobase k_sweep policies protection protection_given recover-rounds source
QUICK := --ratios 10 --seeds 0 --size 240 --steps 150
SCENE ?= $(G2ARD_DATA)/playbot/0_0
bench: setup
	$(BIN)/python -m benchmarks run raster simplify ship recover-regularizers select $(SCENE) -o bench/scene $(QUICK)
	$(BIN)/python -m benchmarks run $(STUDIES) -o bench $(QUICK) --only city,guitar --seconds 8 --adapt-steps 500

# A wheel for this system; nothing but maturin is installed for it.
wheel: $(VENV)/.maturin
	$(BIN)/maturin build --release --locked --out dist

# A wheel for a Linux of any kind, linked by zig against the C library that TAG names. TARGET is Rust's name
# (first: rustup target add $TARGET): {x86_64,aarch64}-unknown-linux-{gnu,musl}, TAG musllinux_1_2 for musl.
TARGET ?= x86_64-unknown-linux-gnu
TAG ?= manylinux_2_28
wheel-linux: $(VENV)/.zig
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/maturin build --release --locked --zig --target $(TARGET) --compatibility $(TAG) --out dist
$(VENV)/.zig:
	test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet "maturin[zig]>=1.12,<2"
	touch $@

# Every command in a terminal, from the wheel with the oldest dependencies that pyproject.toml allows, then the newest.
# Cargo has compiled the same for setup.
ends: setup
	rm -rf dist/ends
	$(BIN)/maturin build --release --locked --quiet --out dist/ends
	$(BIN)/python tests/release/ends.py oldest dist/ends/*.whl
	$(BIN)/python tests/release/ends.py newest dist/ends/*.whl

# What is published, as a user installs it: the wheel and the source distribution, each in a clean environment, run
# README's Use section and must write the same bytes.
release-check: $(VENV)/.maturin
	rm -rf dist/check
	$(BIN)/maturin build --release --locked --sdist --out dist/check
	$(PYTHON) tests/release/check.py dist/check/*.whl dist/check/*.tar.gz

# Unsafe code of the core under Miri, on the portable lanes, in minutes. Needs a nightly toolchain with miri. Tree Borrows, for
# rayon's own crates break Stacked Borrows; rayon's threads never end.
MIRI ?= raster::depth_sort raster::rasterizer raster::visibility train::
miri:
	MIRIFLAGS="-Zmiri-disable-isolation -Zmiri-tree-borrows -Zmiri-permissive-provenance -Zmiri-ignore-leaks" \
		RAYON_NUM_THREADS=2 cargo +nightly miri test -p g2ard-core --lib -- $(MIRI)

clean:
	rm -rf $(VENV) target dist demo site bench
