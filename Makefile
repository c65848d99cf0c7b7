# make demo    set-up, build, the demo scene at ×2, and its page
# make test    every test · make lint · make bench · make sweep · make clean
# make help    all targets

SHELL := /bin/bash
export PATH := $(HOME)/.cargo/bin:$(PATH)
# The libtorch that scripts/setup-libtorch.sh makes, or your own; tests and doctests find it by this.
LIBTORCH_DIR := $(if $(LIBTORCH),$(LIBTORCH),$(CURDIR)/.libtorch)
ifdef LIBTORCH_USE_PYTORCH
LIBTORCH_DIR := $(shell python3 -c 'import pathlib, torch; print(pathlib.Path(torch.__file__).parent)')
endif
export LD_LIBRARY_PATH := $(LIBTORCH_DIR)/lib$(if $(LD_LIBRARY_PATH),:$(LD_LIBRARY_PATH))

NERF_SR := target/release/nerf-sr
# Real scenes and network weights, for the targets that measure.
DATA ?= $(or $(NERF_SR_DATA),../shared/data)
NEXTEST := $(shell command -v cargo-nextest 2>/dev/null)

.PHONY: help demo build setup test lint lego sweep clean goldens

help: ## Show the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST)

setup: ## Put libtorch into .libtorch (once)
	@scripts/setup-libtorch.sh

build: setup ## Build everything in the release profile
	@cargo build --release --workspace --quiet

demo: build ## Set-up, build, demo scene ×2, and the page
	@$(NERF_SR) run

test: build ## Every test; with nextest where it is installed
ifneq ($(NEXTEST),)
	cargo nextest run --release --workspace --no-fail-fast
else
	cargo test --release --workspace --lib --bins --tests
endif
	cargo test --release --workspace --doc

lint: setup ## rustfmt, clippy; cargo-deny and typos where installed
	cargo fmt --all --check
	cargo clippy --release --workspace --all-targets -- -D warnings
	@if command -v cargo-deny >/dev/null; then cargo deny check bans licenses sources; else echo "cargo-deny is not installed: skipped"; fi
	@if command -v typos >/dev/null; then typos; else echo "typos is not installed: skipped"; fi

# The figures of the README's table.
lego: build ## Real lego 100→200, plain NeRF beside supersampling
	@$(NERF_SR) run -j 1 --out out/lego -i dataset=$(DATA)/nerf_synthetic/lego -i weights=$(DATA)/weights \
	  -p rays=40000000 -p supersample=1,2

KERNEL ?= lanczos box
SCALE ?= 2
LR ?= 100
comma := ,
list = $(subst $() $(),$(comma),$(strip $(1)))
sweep: build ## All combinations, e.g. make sweep KERNEL="lanczos box" SCALE="2" LR="50 100"
	@$(NERF_SR) run --out out/sweep -p kernel=$(call list,$(KERNEL)) -p prep.scale=$(call list,$(SCALE)) -p lr=$(call list,$(LR))

goldens: ## Make the golden files anew, with pinned versions of Pillow, scikit-image and PyTorch
	python3 -m venv .venv && .venv/bin/pip install --quiet -r scripts/goldens-requirements.txt && .venv/bin/python scripts/make-goldens.py

clean: ## Remove what was built and run (not .libtorch)
	rm -rf target .nerf-sr out
