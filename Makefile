# make demo    builds the default pipeline's programs and runs the demo scene
# make test    runs all tests · make faults · make lint · make bench · make sweep · make clean
# make help    lists all targets

SHELL := /bin/bash
export PATH := $(HOME)/.cargo/bin:$(PATH)
# libtorch of scripts/setup-libtorch.sh, or of LIBTORCH. LD_LIBRARY_PATH is for doctests and other folders than .libtorch, which no
# rpath covers.
LIBTORCH_DIR := $(if $(LIBTORCH),$(LIBTORCH),$(CURDIR)/.libtorch)
ifdef LIBTORCH_USE_PYTORCH
LIBTORCH_DIR := $(shell python3 -c 'import pathlib, torch; print(pathlib.Path(torch.__file__).parent)')
endif
export LD_LIBRARY_PATH := $(LIBTORCH_DIR)/lib$(if $(LD_LIBRARY_PATH),:$(LD_LIBRARY_PATH))

NERF_SR := target/release/nerf-sr
# Folder with published scenes and network weights, read by the targets that measure.
DATA ?= $(or $(NERF_SR_DATA),../shared/data)

.PHONY: help demo build-demo build remote install dist check-dist setup test faults lint lego sweep quality table results refine-table refine-ablation held-out ablation tradeoff parts seeds stability bench bench-runner compare-engines fuzz clean reference goldens

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST)

# Reports every eight seconds that a silent command is still running.
ALIVE := scripts/alive.sh

setup: ## Download libtorch into .libtorch (once)
	@$(ALIVE) scripts/setup-libtorch.sh

# Built separately: in one build, its features of shared crates would be unified with all other programs', which would be rebuilt.
REMOTE := nerf-sr-remote
build: setup ## Build all programs except nerf-sr-remote in the release profile
	@$(ALIVE) cargo build --release --workspace --exclude $(REMOTE)

remote: ## Build nerf-sr-remote, which shares stores between machines
	@$(ALIVE) cargo build --release -p $(REMOTE)

# The default pipeline's programs build without libtorch. If all programs are built already, the demo uses them: keys are equal.
# tests/first_run.rs compares the copies in target/without-libtorch with the full build.
DEMO_PROGRAMS := nerf-sr demo-scene prep train-ss render-depth eval report
build-demo:
	@command -v cargo >/dev/null || { echo "cargo is missing; install Rust 1.95 or newer (rustup)" >&2; exit 1; }
	@$(ALIVE) cargo build --release --no-default-features $(DEMO_PROGRAMS:%=-p %)
	@mkdir -p target/without-libtorch && cp -f $(DEMO_PROGRAMS:%=target/release/%) target/without-libtorch

demo: $(if $(wildcard target/release/train-refine),build,build-demo) ## Build the default pipeline's programs and run the demo scene at ×2
	@$(NERF_SR) run

PREFIX ?= /usr/local
# Under sudo cargo may not be on the PATH; then the existing build is installed.
install: $(if $(wildcard $(HOME)/.cargo/bin/cargo)$(shell command -v cargo),build remote) ## Install programs, completions and man pages: make install PREFIX=/usr/local DESTDIR=
	@DESTDIR=$(DESTDIR) scripts/install.sh $(PREFIX) $(LIBTORCH_DIR)

test: build remote ## Run all doctests and tests, list skipped and slowest tests; FILTER=TEXT selects tests by name
	cargo test --release --workspace --exclude $(REMOTE) --doc --quiet
	@python3 scripts/run-tests.py $(FILTER)

dist: build remote ## Pack programs, libtorch, completions, man pages and all licences into an archive in target/dist
	@scripts/dist.sh $(LIBTORCH_DIR)

check-dist: dist ## Make the demo's page from the archive on a bare Debian 12 without network (root and debootstrap)
	@scripts/check-dist.sh target/dist/nerf-sr-$$($(NERF_SR) --version | cut -d' ' -f2)-$$(uname -m)-linux.tar.gz $(LIBTORCH_DIR)

KILLS ?= 200
RUNNERS ?= 10
ROUNDS ?= 100
faults: build remote ## Inject faults: kills at random moments and at every call that changes a folder, files changed during runs, concurrent runners: make faults KILLS=200 ROUNDS=100 SEED=1
	NERF_SR_KILLS=$(KILLS) NERF_SR_ROUNDS=$(ROUNDS) NERF_SR_REPEAT=$(RUNNERS) NERF_SR_CALL_STEP=1 $(if $(SEED),NERF_SR_SEED=$(SEED)) \
	  cargo test --release -p end-to-end --test kills --test random_changes --test sharing --test every_call -- --nocapture random_moments eight_runners every_call

# libtorch of `make setup` is for x86-64 only, so that crates that can't do without libtorch aren't checked for aarch64.
ARM := aarch64-unknown-linux-gnu
NEED_LIBTORCH := nets refinement train-refine refine upsample end-to-end
lint: setup ## Run rustfmt, clippy (with and without libtorch, fuzz targets included), and where installed a check for aarch64, cargo-deny and typos
	cargo fmt --all --check
	cargo fmt --manifest-path tests/fuzz/Cargo.toml --check
	cargo clippy --release --workspace --all-targets -- -D warnings
	cargo clippy --release -p train-ss -p render-depth -p register -p eval -p export -p viewer --no-default-features --all-targets -- -D warnings
	@python3 tests/fuzz/seeds.py out/fuzz/seeds
	$(IN_FUZZ) cargo clippy --release -- -D warnings
	@if [ -d "$$(rustc --print sysroot)/lib/rustlib/$(ARM)/lib" ] && command -v aarch64-linux-gnu-gcc >/dev/null; then \
	  cargo check --release --workspace $(NEED_LIBTORCH:%=--exclude %) --no-default-features --target $(ARM); \
	  else echo "$(ARM) (rustup target add) or gcc-aarch64-linux-gnu is not installed: skipped"; fi
	@if command -v cargo-deny >/dev/null; then cargo deny check bans licenses sources; else echo "cargo-deny is not installed: skipped"; fi
	@if command -v typos >/dev/null; then typos; else echo "typos is not installed: skipped"; fi

# Flags of libFuzzer's coverage on a stable compiler. With --target they don't apply to build scripts, which have no libFuzzer to link.
FUZZ_FLAGS := -Cpasses=sancov-module $(addprefix -Cllvm-args=-sanitizer-coverage-,level=4 inline-8bit-counters pc-table trace-compares)
FUZZ_HOST = $(shell rustc -vV | sed -n 's/^host: //p')
FUZZ_TARGETS ?= $(basename $(notdir $(wildcard tests/fuzz/src/bin/*.rs)))
FUZZ_SECONDS ?= 60
IN_FUZZ = cd tests/fuzz && FUZZ_SEEDS=$(CURDIR)/out/fuzz/seeds CARGO_TARGET_DIR=$(CURDIR)/target/fuzz
fuzz: ## Fuzz every reader with damaged files: make fuzz FUZZ_SECONDS=3600 FUZZ_TARGETS="colmap llff"
	@python3 tests/fuzz/seeds.py out/fuzz/seeds
	@$(IN_FUZZ) RUSTFLAGS="$(FUZZ_FLAGS)" cargo build --release --quiet --target $(FUZZ_HOST)
	@for target in $(FUZZ_TARGETS); do mkdir -p out/fuzz/corpus/$$target out/fuzz/seeds/$$target; \
	  target/fuzz/$(FUZZ_HOST)/release/$$target -max_total_time=$(FUZZ_SECONDS) -timeout=20 -rss_limit_mb=2048 -max_len=4096 \
	    -artifact_prefix=out/fuzz/$$target- out/fuzz/corpus/$$target out/fuzz/seeds/$$target 2>&1 | tee out/fuzz/$$target.log | tail -3; \
	  test $${PIPESTATUS[0]} = 0 || exit 1; done

lego: build ## Run lego 100→200 with plain NeRF and with supersampling
	@$(NERF_SR) run -j 1 --out out/lego -i dataset=$(DATA)/nerf_synthetic/lego -i weights=$(DATA)/weights \
	  -p rays=40000000 -p supersample=1,2

KERNEL ?= lanczos box
SCALE ?= 2
LR ?= 100
comma := ,
list = $(subst $() $(),$(comma),$(strip $(1)))
# Size of the demo scene: the sweep's largest HR width.
DEMO_SIZE = $(shell python3 -c 'print(round(max(map(float, "$(LR)".split())) * max(map(float, "$(SCALE)".split()))))')
sweep: build ## Run all combinations: make sweep KERNEL="lanczos average" SCALE="2 4" LR="100 200" DATASET=DIR (default: the demo scene)
	@$(NERF_SR) run --out out/sweep $(if $(DATASET),-i dataset=$(DATASET),-p demo-scene.size=$(DEMO_SIZE)) \
	  -p kernel=$(call list,$(KERNEL)) -p prep.scale=$(call list,$(SCALE)) -p lr_width=$(call list,$(LR))

# Experiments are the files of experiments/. A variable that is set overrides the file's list.
SCENES ?=
PROTOCOLS ?=
# Repeats an option for each value: $(call each,-p ,$(SET)) is -p A=1 -p B=2.
each = $(foreach value,$(2),$(1)$(value))
chosen = $(if $(SCENES),--scene $(call list,$(SCENES))) $(if $(PROTOCOLS),--protocol $(call list,$(PROTOCOLS))) --data $(or $(HELD_OUT),$(DATA)) \
  $(if $(SPLIT),-p split=$(SPLIT)) $(if $(RAYS),-p train-ss.rays=$(RAYS)) $(call each,-p ,$(SET))
# Runs an experiment one stage at a time, so that times are comparable, and copies its rows to OUT (JSON): $(call experiment,NAME,ARGUMENTS)
experiment = $(NERF_SR) run $(1) -j 1 --out out/$(1) $(chosen) $(2) && mkdir -p $(dir $(or $(OUT),out/$(1).json)) && \
  cp out/$(1)/$(1)/rows.json $(or $(OUT),out/$(1).json)
QUALITY := quality$(if $(ENLARGED),-enlarged,$(if $(REFINED),-refined))
quality: build ## Score the protocols on published scenes: make quality DATA=DIR SCENES="lego chair" PROTOCOLS="100x2" REFINED=1 SET="seed=1" OUT=FILE
	@$(call experiment,$(QUALITY))

METHODS ?= nerf nerf-epochs bicubic imdn liif swinir ss kernel refine hr
TABLES := paper-table paper-metrics paper-times
TABLE = $(or $(OUT),out/table.md)
# A quarter of the rays for fields with one ray per pixel instead of four, or with a quarter of the pixels per image.
fewer_rays = -p train-ss.rays=$(1) $(foreach field,field-nerf-epochs downscaled-field,-p $(field).rays=$$(($(1) / 4)))
table: build ## Write the paper's tables with all methods: make table SCENES="lego" PROTOCOLS="100x2" METHODS="nerf bicubic imdn ss" OUT=FILE.md
	@$(NERF_SR) run $(TABLES) -j 1 --data $(DATA) $(if $(SCENES),--scene $(call list,$(SCENES))) $(if $(PROTOCOLS),--protocol $(call list,$(PROTOCOLS))) \
	  --show $(call list,$(METHODS)) $(if $(SPLIT),-p prep.split=$(SPLIT)) $(if $(RAYS),$(call fewer_rays,$(RAYS))) \
	  $(if $(filter file,$(origin KERNEL)),,-p prep.kernel=$(firstword $(KERNEL))) $(call each,-p ,$(SET))
	@mkdir -p $(dir $(TABLE)) && cat $(TABLES:%=out/%/table.md) > $(TABLE)
	@for kind in json csv; do cp out/paper-table/rows.$$kind $(basename $(TABLE)).$$kind; done

# The comment above a table is the command that writes the table into out/. An interrupted run resumes.
PAGES ?= *
results: SCENES = lego chair fern
results: build held-out ## Run the experiments of docs/results (hours) and update its tables: make results PAGES=objects
	@cat docs/results/$(PAGES).md | sed -n 's/^<!-- nerf-sr \(.*\) -->$$/\1/p' | awk '!seen[$$0]++' > out/experiments.txt
	@while read -r arguments; do echo "nerf-sr $$arguments"; \
	  case "$$arguments" in "run tradeoff"*) data=out/held-out;; *) data=$(DATA);; esac; \
	  $(NERF_SR) $$arguments -j 1 --data "$$data" </dev/null || exit 1; done < out/experiments.txt
	UPDATE=1 cargo test --release --workspace --exclude $(REMOTE) --test results --quiet -- --nocapture what_was_measured

REFERENCES ?= 1
MOST_REFERENCES = $(shell printf '%s\n' $(REFERENCES) | sort -n | tail -1)
refine-table: build ## Compare rendered and refined views: make refine-table SCENES=fern PROTOCOLS="252x2 252x4" REFERENCES="1 2 4" SPLIT=paper OUT=FILE
	@$(call experiment,refine-table,$(call each,--variant ,$(REFERENCES)) -p prep.hr_references=$(MOST_REFERENCES))

PAPER_STEPS ?= 400
refine-ablation: build ## Measure the PSNR gain of each part of refinement, on downscaled views left out of the training
	@$(call experiment,refine-ablation,$(if $(VARIANTS),--first-variants $(VARIANTS)))
ifneq ($(PAPER_STEPS),0)
	@$(NERF_SR) run paper-ablation -j 1 --out out/paper-ablation $(chosen) -p train-paper.steps=$(PAPER_STEPS)
endif

# Data sets whose test views are withheld training views; settings are chosen on them. `prep` itself holds photographs out.
held-out:
	@mkdir -p out/held-out; if [ -d $(DATA)/weights ]; then ln -sfn "$$(realpath $(DATA)/weights)" out/held-out/weights; fi; for scene in $(or $(SCENES),lego chair); do for folder in nerf_synthetic nerf_llff_data .; do \
	  if [ -f $(DATA)/$$folder/$$scene/transforms_train.json ]; then python3 scripts/hold-out.py $(DATA)/$$folder/$$scene out/held-out/$$scene; break; \
	  elif [ -d $(DATA)/$$folder/$$scene ]; then ln -sfn "$$(realpath $(DATA)/$$folder/$$scene)" out/held-out/$$scene; break; fi; done; done >/dev/null

ablation tradeoff: HELD_OUT = out/held-out
ablation: build held-out ## Measure PSNR and time of each part of the training, on withheld training views
	@$(call experiment,ablation,$(if $(VARIANTS),--first-variants $(VARIANTS)))

tradeoff: build held-out ## Measure accuracy, time and memory of the qualities and of parts, on withheld views: make tradeoff SCENES=fern PROTOCOLS=252x2
	@$(call experiment,tradeoff)

parts: build ## Measure what parts bring to scenes that require them and to scenes that don't
	@$(call experiment,parts)

seeds: build ## Measure the spread of the PSNR over ten seeds of the demo scene
	@$(call experiment,seeds)

stability: build ## Run the programs at the extremes of their inputs and parameters: docs/results/stability.md
	@mkdir -p out
	@cargo test --release -p radiance --lib --quiet errors_of_single_precision -- --nocapture > out/precision.txt || { cat out/precision.txt; exit 1; }
	UPDATE=1 cargo test --release -p end-to-end --test stability --quiet -- --nocapture table

bench-runner: build ## Measure the runner's overhead against DVC and Snakemake (installed by pip): out/bench-runner/table.md
	@python3 scripts/bench-runner.py

BENCH_SCENE := out/bench/scene
# Passed to both builds, because the default differs in older ones.
BENCH_RAYS := $(or $(RAYS),3000000)
bench: build ## Measure the engine's speed: rows of JSON in OUT=FILE (lego from DATA, otherwise the demo scene); SIMD=avx2|portable; AGAINST=FILE of an earlier run, or the folder of another checkout
	@rm -rf out/bench && mkdir -p out/bench
	@if [ -d $(DATA)/nerf_synthetic/lego ]; then ln -s $(abspath $(DATA))/nerf_synthetic/lego out/bench/data; \
	  else target/release/demo-scene --output out/bench/data; fi
	@echo '{"lr_width": 100, "scale": 2, "test_views": 10}' > out/bench/prep.json
	@target/release/prep --params out/bench/prep.json --input dataset=out/bench/data --output $(BENCH_SCENE)
	@against="$(abspath $(AGAINST))"; if [ -d "$$against" ]; then $(MAKE) -C "$$against" bench AGAINST= RAYS=$(BENCH_RAYS) DATA=$(abspath $(DATA)) OUT=$(abspath out/bench-against.json) && against=$(abspath out/bench-against.json) || exit; fi; \
	  SCENE=$(abspath $(BENCH_SCENE)) OUT=$(abspath $(or $(OUT),out/bench.json)) SIMD=$(SIMD) RAYS=$(BENCH_RAYS) AGAINST="$$against" cargo bench --quiet -p train-ss --bench bench

compare-engines: build ## Compare training and rendering of this build and of AGAINST=DIR, another built checkout; RAYS="FACTOR …" or BUDGETS=1, SCENES="lego 100x2" PICTURE=FILE.svg
	@python3 scripts/compare-engines.py $(AGAINST) . --data $(DATA) $(if $(RAYS),--rays $(RAYS)) $(if $(BUDGETS),--budgets) $(if $(SCENES),--only "$(SCENES)") $(if $(PICTURE),--picture $(PICTURE))

reference: build ## Regenerate schemas/ and docs/reference/ from the types and the built programs
	UPDATE=1 cargo test --release --workspace --exclude $(REMOTE) --test schemas

goldens: ## Regenerate the golden files with pinned versions of Pillow, scikit-image and PyTorch
	python3 -m venv .venv && .venv/bin/pip install --quiet -r scripts/goldens/requirements.txt && .venv/bin/python scripts/goldens

clean: ## Remove target, .nerf-sr and out (not .libtorch)
	rm -rf target .nerf-sr out
