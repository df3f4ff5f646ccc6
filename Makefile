# `make train`, `make test` and `make loop` install everything they need into .venv first. Others: CONTRIBUTING.md.
PYTHON ?= python3
VENV ?= .venv
RUN ?= runs/train
LOOP ?= runs/loop
BIN := $(VENV)/bin
COMMA := ,
PIP := $(BIN)/python -m pip --disable-pip-version-check

# $(call once_more,COMMAND): a run of tests. Failed ones run once more, alone: what passes there failed by what ran beside it.
define once_more
	$(1) || { [ $$? -eq 1 ] && echo "The failed tests run once more, alone." && \
		$(BIN)/python -m pytest -q --last-failed --last-failed-no-failures none; }
endef

.PHONY: train loop test test-quick test-long lint docs notebooks coverage constraints release clean

# $(call beating,COMMAND): a command, and every 8 s a line with the time that it has taken.
define beating
	@( seconds=0; while sleep 8; do seconds=$$((seconds + 8)); echo "  installing for $$seconds s"; done ) & beat=$$!; \
		trap "kill $$beat 2>/dev/null" EXIT INT TERM; $(1)
endef

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$(PYTHON) is older than 3.11: call make with PYTHON=python3.11 (or newer)"; exit 1; }
	@$(PYTHON) -m ensurepip --version >/dev/null 2>&1 || \
		{ echo "$(PYTHON) cannot make virtual environments; on Debian or Ubuntu run: apt-get install -y python3-venv"; exit 1; }
	@echo "Making the virtual environment $(VENV)."
	$(call beating,$(PYTHON) -m venv $(VENV))

# jax[cuda13] is added where nvidia-smi answers.
$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@if nvidia-smi -L >/dev/null 2>&1; then \
		echo "Installing whill-mjx with JAX for NVIDIA GPUs into $(VENV): once, several minutes and GB."; \
		else echo "Installing whill-mjx with JAX, MuJoCo and ONNX into $(VENV): once, 1 to 5 minutes, 1.5 GB."; fi
	$(call beating,$(PIP) install -c constraints.txt -e "$$(nvidia-smi -L >/dev/null 2>&1 && echo '.[cuda]' || echo .)")
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo "Installing what the tests need (pytest, ruff, mypy, ROS 2 messages) into $(VENV): once, about a minute."
	$(call beating,$(PIP) install -c constraints.txt -e ".[dev$(COMMA)ros]")
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	@echo "Installing what the site needs (MkDocs, jupytext) into $(VENV): once, some seconds."
	$(call beating,$(PIP) install -c constraints.txt -e ".[docs]")
	@touch $@

train: $(VENV)/.installed
	$(BIN)/python -m whill_mjx.train --out $(RUN)

# Drive, record, fit, find what is missing, drive again, train, drive: over ROS 2, on the contact plant.
loop: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.loop --out $(LOOP)

test: $(VENV)/.installed-dev
	$(call once_more,$(BIN)/python -m pytest -q --cache-clear -n 2 --dist loadfile --durations 30)

test-quick: $(VENV)/.installed-dev
	$(call once_more,$(BIN)/python -m pytest -q --cache-clear -n 2 --dist loadfile -m quick)

# Damage, kills and full disks in numbers, and the seconds of each notebook: an hour or more.
test-long: $(VENV)/.installed-dev $(VENV)/.installed-docs
	$(BIN)/python -m pytest -q -m long
	$(BIN)/python -m benchmarks.tutorials run --notebooks --record

lint: $(VENV)/.installed-dev
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy whill_mjx sysid dreamer bridge benchmarks

# Lines and branches that the suite runs; a page in build/coverage.
coverage: $(VENV)/.installed-dev
	$(PIP) install -q -c constraints.txt pytest-cov
	$(BIN)/python -m pytest -q --cache-clear -n 2 --dist loadfile --cov --cov-report=term:skip-covered --cov-report=html:build/coverage

# Renew constraints.txt: the newest versions that pyproject.toml allows, for every Python of PYTHONS. Then run the tests.
PYTHONS ?= python3.11 python3.12 python3.13
constraints:
	mkdir -p build/constraints
	rm -f build/constraints/freeze-*
	for python in $(PYTHONS); do \
		version=$$($$python -c 'import sys; print("%d.%d" % sys.version_info[:2])') || exit 1; \
		rm -rf build/constraints/venv && $$python -m venv build/constraints/venv || exit 1; \
		echo "Python $$version: installing the newest versions."; \
		build/constraints/venv/bin/pip install -q ".[dev$(COMMA)ros$(COMMA)docs]" pytest-cov || exit 1; \
		build/constraints/venv/bin/pip freeze --exclude whill-mjx > build/constraints/freeze-$$version || exit 1; \
	done
	rm -rf build/constraints/venv
	$(firstword $(PYTHONS)) .ci/constraints.py build/constraints/freeze-*
	git diff --stat constraints.txt

# Wheels and source archives in dist/, tried in clean environments of Python 3.11 to 3.13 (VERSIONS=3.12 for one).
VERSIONS ?= 3.11 3.12 3.13
release: $(VENV)/.installed-dev
	$(PIP) install -q -c constraints.txt build
	.ci/release $(BIN)/python $(VERSIONS)

# The site in build/site: every link and picture is checked, and a broken one fails.
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "Open build/site/index.html. With its search: python3 -m http.server -d build/site"

# The tutorials as notebooks in build/notebooks.
notebooks: $(VENV)/.installed-docs
	$(BIN)/python -m benchmarks.tutorials notebooks --out build/notebooks

clean:
	rm -rf $(VENV) build
