# One command each: `make demo` runs the main job, `make test` proves the project. Both set up what they need.

export UV ?= $(or $(shell command -v uv 2>/dev/null),$(CURDIR)/.tools/bin/uv)
PYTHON ?= python3
RUN = $(UV) run --no-sync

.DEFAULT_GOAL := help
.PHONY: help demo test hostile fuzz-api chaos load bench bench-train bench-scaling bench-transfer
.PHONY: lint format setup setup-dev setup-trainer servers compose-check compose-chaos demo-model clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: setup ## label a simulated drive through the service; DRIVE=log MODEL=bundle take your own
	$(RUN) l3ps demo $(if $(DRIVE),--drive "$(DRIVE)") $(if $(MODEL),--model "$(MODEL)")

test: lint servers ## style, types, import rules and every test
	$(RUN) pytest

hostile: servers ## every hostile upload on both stacks, a million empty files among them; ONLY=names takes some
	L3PS_HOSTILE="$(or $(ONLY),.)" $(RUN) pytest tests/hostile --timeout 3600

chaos: servers ## kill real processes and servers under running jobs; SCENARIO=name runs one; writes chaos-report.md
	L3PS_CHAOS=1 $(RUN) pytest --timeout 900 tests/chaos $(if $(SCENARIO),-k "$(SCENARIO)")

bench-scaling: servers ## the same scenes with one worker and with two, one thread each
	$(RUN) python tests/load/scaling.py

fuzz-api: servers ## send the API what its OpenAPI document allows and forbids; EXAMPLES=200 an operation take minutes
	L3PS_FUZZ_EXAMPLES=$(or $(EXAMPLES),200) $(RUN) pytest -s --timeout 900 tests/contract/api/test_openapi_document.py

lint: setup-dev
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy shared/l3ps shared/l3ps_client shared/l3ps_cluster shared/l3ps_platform services/*/l3ps_*
	$(RUN) lint-imports

format: setup-dev ## put the code into the house style
	$(RUN) ruff check --fix .
	$(RUN) ruff format .

servers: setup-dev
	$(RUN) python tests/setup_servers.py

setup: $(UV)
	$(UV) sync --frozen --inexact --no-dev --package l3ps-cli --package l3ps-api --package l3ps-worker

setup-trainer: setup ## what `l3ps train` needs: torch, 6 GB on disk
	$(UV) sync --frozen --inexact --no-dev --package l3ps-trainer

setup-dev: $(UV)
	$(UV) sync --frozen --all-packages

# Without uv on the machine: the one from the Python package index, in a folder of its own.
$(CURDIR)/.tools/bin/uv:
	$(PYTHON) -m venv $(CURDIR)/.tools
	$(CURDIR)/.tools/bin/pip install --quiet 'uv>=0.9'

bench: $(UV) ## measure refinement and its peers on LOG=log; SCANS=12 takes the first of them
	@test -n "$(LOG)" || { echo 'Name a drive log: make bench LOG=path' >&2; exit 2; }
	$(UV) sync --frozen --inexact --all-packages --group bench
	$(RUN) l3ps bench refine --log "$(LOG)" $(if $(SCANS),--scans $(SCANS))

bench-train: setup-dev ## train on IMAGES=folder over BACKBONE=spec, score on VALIDATION=folder; COUNT=10 takes so many images, CLASSES=file
	@test -n "$(IMAGES)" -a -n "$(BACKBONE)" -a -n "$(VALIDATION)" || \
	  { echo 'Name all three: make bench-train IMAGES=folder BACKBONE=spec VALIDATION=folder' >&2; exit 2; }
	$(RUN) l3ps train "$(IMAGES)" --backbone "$(BACKBONE)" --validation "$(VALIDATION)" --fresh --out bench-train \
	  $(if $(CLASSES),--classes "$(CLASSES)") $(if $(COUNT),--images $(COUNT))

load: servers ## 200 clients read their job's status for 3 minutes while two workers are busy; writes load-report.json
	$(RUN) python tests/load/status.py

bench-transfer: servers ## a large file up and down beside the bare minio client; MB=2048 ROUNDS=3; transfer-report.json
	$(RUN) python tests/load/transfer.py $(if $(MB),--mb $(MB)) $(if $(ROUNDS),--rounds $(ROUNDS))

compose-check: setup ## bring the compose stack up with a real Docker engine, push a drive through, tear it down
	$(RUN) python deploy/compose_check.py

compose-chaos: setup ## the same, and kill -9 of every container in turn, each during a job; needs root
	$(RUN) python deploy/compose_check.py --kill

demo-model: setup-dev ## train the demo's model again, from thirty simulated images
	rm -rf demo-model
	$(RUN) l3ps simulate-images --count 30 --seed 1000 --choose-from 90 --out demo-model/train
	$(RUN) l3ps simulate-images --count 24 --seed 2000 --out demo-model/check
	$(RUN) l3ps train demo-model/train --backbone scratch --validation demo-model/check --seed 1 --threads 1 \
	  --name demo-simulated-k30 --out demo-model/bundle
	cp demo-model/bundle/model.* demo-model/bundle/report.* services/cli/l3ps_cli/models/demo/

clean: ## remove what the targets made here
	rm -rf .venv .tools .mypy_cache .ruff_cache .hypothesis demo demo-model bench-train chaos-report.*
