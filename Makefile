# Each target makes the virtual environment .venv, or brings it up to date, by itself.
PYTHON ?= python3
OLDEST_PYTHON ?= python3.10
# On Linux, the registry's torch comes with several GB of CUDA. For the CPU build, name PyTorch's
# own index of CPU builds (pytorch.org, "Get started"):
#   make run TORCH_INDEX=...
TORCH_INDEX ?=
# A run is never written over: each has a folder of its own
OUT ?= runs/quick-$(shell date +%Y%m%d-%H%M%S)

BIN := .venv/bin
STAMP := .venv/installed
SETTINGS := constraints.txt setup.cfg pyproject.toml wrappers/setup.cfg wrappers/pyproject.toml

.PHONY: run test lint docs links dist test-oldest clean
.DELETE_ON_ERROR:

run: $(STAMP)
	$(BIN)/regil train --preset quick --env regil/metaworld-button-press-v0 --out $(OUT)

test: $(STAMP)
	$(BIN)/python -m pytest -m "not slow"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy regil_sb3 wrappers/regil_wrappers

docs: $(STAMP)
	$(BIN)/python -m sphinx -W --keep-going docs build/docs

# Whether every address that the documentation names answers; needs the internet
links: $(STAMP)
	$(BIN)/python -m sphinx -b linkcheck -q docs build/links

# Wheels and sdists of both, the same to the bit from the same commit
dist: $(STAMP)
	$(BIN)/python .ci/dist.py dist

# The tests with the oldest versions that setup.cfg allows, in .venv-oldest
test-oldest:
	test -x .venv-oldest/bin/python || $(OLDEST_PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install --quiet -c constraints-oldest.txt \
	    $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch
	.venv-oldest/bin/python -m pip install --quiet -c constraints-oldest.txt -e ./wrappers -e '.[tests]'
	.venv-oldest/bin/python -m pip install --quiet --no-deps -c constraints-oldest.txt \
	    robosuite hf-libero bddl
	.venv-oldest/bin/python -m pytest -m "not slow and not packaging"

clean:
	rm -rf .venv .venv-oldest build dist *.egg-info wrappers/build wrappers/dist wrappers/*.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# torch first and alone: another package's open range would fetch the newest build of it.
# The simulators of LIBERO last: what they declare to need, they do not, and it holds a second OpenCV.
$(STAMP): $(SETTINGS)
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt \
	    $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ./wrappers -e '.[tests]'
	$(BIN)/python -m pip install --quiet --no-deps -c constraints.txt robosuite hf-libero bddl
	touch $@
