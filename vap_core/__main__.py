"""`python -m vap_core`: the command line; without the environment, what is missing of it.

Runs under Python 3.9 and later, by the standard library alone, up to the import of the commands.
"""

import os
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def absent_packages(project: Path) -> "list[str]":
    """The packages that pyproject.toml asks for and this Python lacks."""
    text = project.read_text(encoding="utf-8") if project.is_file() else ""
    wanted = re.search(r"^dependencies = \[(.*?)^\]", text, re.MULTILINE | re.DOTALL)
    absent = []
    for name in re.findall(r'^ *"([\w-]+)', wanted[1] if wanted else "", re.MULTILINE):
        try:
            version(name)
        except PackageNotFoundError:
            absent.append(name)
    return absent


def without_environment() -> str:
    """Why no command runs under this Python, in a line; `doctor` prints all that it finds first."""
    python = sys.version.split()[0]
    pinned = ROOT / ".python-version"
    wanted = pinned.read_text(encoding="utf-8").strip() if pinned.is_file() else "3.12"
    venv = ROOT / ".venv" / "bin" / "python"
    remedy = "use ./vap" if venv.is_file() else "run `make setup`, then ./vap"
    absent = absent_packages(ROOT / "pyproject.toml")
    if sys.argv[-1:] == ["doctor"]:
        drivers = [list(Path(r, "vulkan/icd.d").glob("*.json")) for r in ("/usr/share", "/etc")]
        display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        rows = (
            (python.startswith(f"{wanted}."), "python", python, f"{python}; it needs {wanted}"),
            (venv.is_file(), "environment", str(venv), f"no {venv}; run make setup"),
            (not absent, "packages", "", f"{len(absent)} absent: {', '.join(absent)}"),
            (any(drivers), "pictures of recordings", "", "apt-get install -y mesa-vulkan-drivers"),
            (bool(display), "display", str(display), "none: use --png instead of a window"),
        )
        for works, what, found, mend in rows:
            print(f"{'ok' if works else 'MISSING':<7}  {what:<22} {found if works else mend}")
    where = f"for {sys.executable} (Python {python})"
    return f"error: vap_core's packages are not installed {where}; {remedy}"


if __name__ == "__main__":
    try:
        from vap_core.cli import main
    except (ModuleNotFoundError, SyntaxError):
        if not absent_packages(ROOT / "pyproject.toml"):
            raise
        sys.exit(without_environment())
    main()
