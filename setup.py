"""What pyproject.toml cannot say: a wheel holds the files of data/ that the package reads.

They go to vap_core/data (vap_core.base.files.DATA); a checkout reads them where they are.
MANIFEST.in names the same files for a source distribution.
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SHIPPED = (
    "catalogue",
    "paper_tables.csv",
    "paraphrases",
    "photo-set",
    "policies",
    "suites",
    "weights",
)


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


setup(cmdclass={"build_py": BuildWithData})
