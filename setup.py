"""What pyproject.toml cannot say: a wheel holds the files of data/ that the package reads.

They go to vap_core/data (vap_core.base.files.DATA); a checkout reads them where they are.
MANIFEST.in names the same files for a source distribution.
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SHIPPED = (
    "paper_tables.csv",
    "paraphrases",
    "photo-set",
    "policies",
    "results/readings.csv",
    "suites",
    "weights",
)
LEFT_OUT = (
    "policies/mini-paligemma",
    "policies/mini-pi0-simpler-bridge",
    "policies/mini-pi0-simpler-bridge-tint-free",
    "policies/mini-pi0-simpler-bridge-wide",
    "policies/mini-pi0-simpler-fractal",
    "policies/mini-pi0-simpler-fractal-tint-free",
    "policies/mini-pi0-tabletop",
    "policies/mini-pi0-tabletop-wide",
    "policies/mini-pi0-vlabench",
    "policies/mini-pi0-vlabench-tint-free",
)
"""Studied in notebooks and docs, and named by no command: they stay in the repository alone."""


class BuildWithData(build_py):
    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        target = Path(self.build_lib, "vap_core", "data")
        shutil.rmtree(target, ignore_errors=True)
        for name in SHIPPED:
            source = Path("data", name)
            if source.is_dir():
                shutil.copytree(source, target / name)
            else:
                copy = target / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, copy)
        for name in LEFT_OUT:
            shutil.rmtree(target / name, ignore_errors=True)


setup(cmdclass={"build_py": BuildWithData})
