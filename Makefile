.PHONY: setup demo test lab lock clean
.DEFAULT_GOAL := help

RUN := OMP_NUM_THREADS=1 .venv/bin/python

help:
	@echo "make demo    set up what is missing, then the main job: VAP against generic on two robots, with recordings"
	@echo "make test    set up what is missing, then lint, types, tests and notebooks"
	@echo "make lab     open the notebooks in JupyterLab"
	@echo "make setup   only set up .venv      make lock   renew environment.txt from pyproject.toml"
	@echo "make clean   remove .venv and caches; data/ stays"

setup: .venv/.ready

.venv/.ready: environment.txt pyproject.toml
	@PYTHON="$(PYTHON)" bash .ci/setup

demo: setup
	@$(RUN) -m vap_core demo

test: setup
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy
	$(RUN) -m pytest -n 2 --dist loadfile -m "not alone"
	$(RUN) -m pytest -m alone
	$(RUN) -m pytest --nbval-lax notebooks

lab: setup
	.venv/bin/jupyter lab --ip 127.0.0.1 notebooks

lock:
	uv pip compile --quiet pyproject.toml --extra dev --universal --python-version 3.12 --generate-hashes --no-annotate --output-file environment.txt

clean:
	rm -rf .venv build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
