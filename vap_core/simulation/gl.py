"""Choose an off-screen OpenGL back end before MuJoCo draws.

A missing one raises a clear error and does not end the process.
"""

import importlib
import importlib.util
import os
import subprocess
import sys
from functools import cache

from vap_core.base.errors import MissingGL

BACKENDS = ("egl", "osmesa")
PROVEN = "VAP_CORE_GL"
"""Environment variable that hands the probe's answer down to worker processes."""
REMEDY = "apt-get install -y --no-install-recommends libegl1 libgl1"
_PROBE = """
import os
os.environ["MUJOCO_GL"] = {backend!r}
os.environ.pop("PYOPENGL_PLATFORM", None)
import mujoco
context = mujoco.GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
context.free()
os._exit(0)
"""


@cache
def works(backend: str) -> bool:
    """Whether `backend` can make a context here.

    A child process tries it, so that a crash in a driver does not end this one.

    Raises: MissingGL: mujoco is not installed.
    """
    if importlib.util.find_spec("mujoco") is None:
        raise MissingGL(
            "ensure_gl: the package mujoco is not installed. Run: pip install -r environment.txt"
        )
    probe = subprocess.run(
        [sys.executable, "-c", _PROBE.format(backend=backend)],
        capture_output=True,
        check=False,
        timeout=120,
    )
    return probe.returncode == 0


def ensure_gl() -> str:
    """Set `MUJOCO_GL` to a back end that draws without a display here, and return its name.

    Call it before importing mujoco where possible; a mujoco that is already imported is switched
    over. A back end that the user set is probed and kept; one that this process or its parent found
    to work is not probed again.

    Raises: MissingGL with the line to run.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen and (os.environ.get(PROVEN) == chosen or works(chosen)):
        os.environ[PROVEN] = chosen
        return chosen
    if chosen:
        raise MissingGL(
            f"ensure_gl: MUJOCO_GL={chosen} cannot draw on this machine. Unset it, or run: {REMEDY}"
        )
    for backend in BACKENDS:
        if works(backend):
            os.environ["MUJOCO_GL"] = backend
            os.environ[PROVEN] = backend
            if "mujoco" in sys.modules:
                context = importlib.import_module("mujoco.rendering.classic.gl_context")
                importlib.reload(context)
            return backend
    raise MissingGL(
        f"ensure_gl: no OpenGL back end of {', '.join(BACKENDS)} can draw without a display. "
        f"Run: {REMEDY}"
    )


if __name__ == "__main__":
    print(ensure_gl())
