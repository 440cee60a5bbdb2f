"""The server that workers are forked from."""

import ast
import subprocess
import sys

import pytest

COLLECTS = """
from vap_core.study.workers import prepare
from vap_core.study.workers import results

prepare(("json",))
asked = [
    "(lambda gc: (gc.isenabled(), gc.get_freeze_count() > 1000))(__import__('gc'))",
    "__import__('importlib.util').util.find_spec('sklearn') is not None",
    "__import__('importlib.metadata').metadata.packages_distributions()['PIL']",
]
print([answer for _, answer in sorted(results(eval, asked, 1, "--workers"))])
"""
STARTS = """
import sys
from vap_core.cli import main

sys.argv = ["vap_core", *{arguments!r}]
try:
    main()
finally:
    heavy = ("mujoco", "pandas", "cv2", "torch", "beartype", "numpy")
    print([name for name in heavy if name in sys.modules])
"""

WITHOUT_TORCH = """
import sys

sys.modules["torch"] = None
import vap_core.cli
import vap_core.recording
import vap_core.simulation.suites.open_row
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    """A process of its own."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)


def test_a_worker_collects_garbage_but_not_among_imports_and_can_import_what_was_hidden() -> None:
    done = run(COLLECTS)
    assert done.stdout.strip() == "[(True, True), ['pillow'], True]", done.stderr[-500:]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--suite", "nowhere.py"), "nowhere.py is no Python file"),
        (("--suite", "simpler-bridge", "--policy", "/no/where"), "'/no/where' is unknown"),
        (("--suite", "simpler-bridge", "--record", "some"), "say all, failures, none"),
    ],
)
def test_a_wrong_argument_is_told_before_anything_large_is_imported(
    arguments: tuple[str, ...], says: str
) -> None:
    done = run(STARTS.format(arguments=("eval", *arguments)))
    assert says in done.stderr
    assert done.returncode == 2
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("arguments", "says", "absent"),
    [
        (("bench", "nonsense"), "known: eval, policy, profile", {"mujoco", "cv2"}),
        (("train", "policy", "--suite", "nonsense"), "'nonsense' is unknown", {"torch"}),
        (("train", "demonstrations", "--suite", "nonsense"), "'nonsense' is unknown", {"torch"}),
    ],
)
def test_a_wrong_name_is_told_before_what_it_would_choose_is_imported(
    arguments: tuple[str, ...], says: str, absent: set[str]
) -> None:
    done = run(STARTS.format(arguments=arguments))
    assert says in done.stderr
    assert done.returncode == 2
    assert not absent & set(ast.literal_eval(done.stdout))


def test_commands_simulator_and_recordings_need_no_torch() -> None:
    done = run(WITHOUT_TORCH)
    assert done.returncode == 0, done.stderr[-500:]
