"""The front door opens fast and loads nothing heavy."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import vap_core

HEAVY = ("torch", "mujoco", "rerun", "transformers", "matplotlib", "pandas", "cv2", "onnxruntime")


def loaded_by(module: str, watched: tuple[str, ...]) -> str:
    """Which of the watched modules an import loads, as a process of its own prints them."""
    code = f"import sys, {module}; print([m for m in {watched!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_import_loads_nothing_heavy() -> None:
    assert loaded_by("vap_core", HEAVY) == "[]"


def test_import_is_fast() -> None:
    code = "import time; t = time.process_time(); import vap_core; print(time.process_time() - t)"
    took = [
        float(
            subprocess.run(
                [sys.executable, "-c", code], capture_output=True, text=True, check=True
            ).stdout
        )
        for _ in range(3)
    ]
    assert min(took) < 0.3


def test_every_exported_name_exists() -> None:
    for name in vap_core.__all__:
        assert getattr(vap_core, name) is not None


def test_type_checkers_see_the_names_that_load() -> None:
    tree = ast.parse(Path(vap_core.__file__).read_text())
    seen = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("vap_core."):
            for alias in node.names:
                if alias.asname is not None:
                    seen.add(alias.name)
    assert seen == set(vap_core.__all__)


@pytest.mark.parametrize(
    "package",
    [
        "vap_core.study",
        "vap_core.rollout",
        "vap_core.simulation",
        "vap_make",
    ],
)
def test_every_name_of_a_package_exists(package: str) -> None:
    module = import_module(package)
    for name in module.__all__:
        assert getattr(module, name) is not None


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        # The parent of a run starts its workers at once; only they load a policy.
        ("vap_core.study.engine", ("torch", "lerobot", "transformers", "rerun")),
        # A policy in another process needs no lerobot here.
        ("vap_core.policies.lerobot.adapter", ("lerobot", "transformers")),
    ],
)
def test_an_import_loads_no_policy_library(module: str, absent: tuple[str, ...]) -> None:
    assert loaded_by(module, absent) == "[]"
