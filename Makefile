# `make train`, `make test` and `make loop`. They install everything they need into .venv first.
PYTHON ?= python3
VENV ?= .venv
RUN ?= runs/train
LOOP ?= runs/loop
BIN := $(VENV)/bin
COMMA := ,
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: train loop test test-quick test-long lint clean

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

train: $(VENV)/.installed
	$(BIN)/python -m whill_mjx.train --out $(RUN)

# Drive, record, fit, find what is missing, drive again, train, drive: over ROS 2, on the contact plant.
loop: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.loop --out $(LOOP)

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --durations 30

test-quick: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m quick

# Damage, kills and full disks in numbers: an hour or more.
test-long: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -m long

lint: $(VENV)/.installed-dev
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy whill_mjx sysid dreamer bridge benchmarks

clean:
	rm -rf $(VENV)
