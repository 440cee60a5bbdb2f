"""Choose an off-screen OpenGL back end before MuJoCo draws.

A missing one raises a clear error and does not end the process.
"""

import importlib
import importlib.util
import os
import resource
import subprocess
import sys
from functools import cache
from threading import local

from vap_core.base.errors import MissingGL

BACKENDS = ("egl", "osmesa")
PROVEN = "VAP_CORE_GL"
"""Environment variable that hands the probe's answer down to worker processes."""
REMEDY = "apt-get install -y --no-install-recommends libegl1 libgl1"
_PROBE = """
import os
import mujoco
context = mujoco.GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
context.free()
os._exit(0)
"""


def settings(backend: str) -> dict[str, str]:
    """The variables that make MuJoCo draw with `backend`: those of the probe are those of the run.

    PyOpenGL's has to agree with MuJoCo's, whatever was set before.
    """
    found = {"MUJOCO_GL": backend, PROVEN: backend}
    return found | ({"PYOPENGL_PLATFORM": backend} if backend in BACKENDS else {})


@cache
def fault(backend: str) -> str | None:
    """Why `backend` can make no context here, as MuJoCo says it; None when it can.

    A child process tries it, so that a crash in a driver does not end this one.

    Raises: MissingGL: mujoco is not installed.
    """
    if importlib.util.find_spec("mujoco") is None:
        raise MissingGL(
            "ensure_gl: the package mujoco is not installed. Run: pip install -r environment.txt"
        )
    probe = subprocess.run(
        [sys.executable, "-c", _PROBE],
        env={**os.environ, **settings(backend)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    if probe.returncode == 0:
        return None
    lines = [line for line in probe.stderr.splitlines() if line and not line.startswith(" ")]
    # While it is taken down, PyOpenGL may fail once more.
    said = [line for line in lines if "Error" in line and "__del__" not in line]
    return (said or lines or [f"the driver ended the process with {probe.returncode}"])[0][:300]


def ensure_gl() -> str:
    """Set the variables of a back end that draws without a display here, and return its name.

    Call it before importing mujoco where possible; a mujoco that is already imported is switched
    over. A back end that the user set is probed and kept; one that this process or its parent found
    to work is not probed again.

    Raises: MissingGL with the cause that MuJoCo gives, and the line to run.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    causes = {}
    for backend in (chosen,) if chosen else BACKENDS:
        if os.environ.get(PROVEN) != backend:
            cause = fault(backend)
            if cause is not None:
                causes[backend] = cause
                continue
        os.environ.update(settings(backend))
        if not chosen and "mujoco" in sys.modules:
            importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
        return backend
    said = "; ".join(f"{backend}: {cause}" for backend, cause in causes.items())
    what = f"MUJOCO_GL={chosen}" if chosen else f"no back end of {', '.join(BACKENDS)}"
    unset = " unset MUJOCO_GL, or" if chosen else ""
    device = " unset MUJOCO_EGL_DEVICE_ID, or" if "MUJOCO_EGL_DEVICE_ID" in os.environ else ""
    limited = resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY
    limit = " raise the limit of memory (ulimit -v), or" if limited else ""
    raise MissingGL(
        f"ensure_gl: {what} {'cannot' if chosen else 'can'} draw without a display ({said}). "
        f"Mend what is named there;{limit}{unset}{device} run: {REMEDY}"
    )


def keep_contexts() -> None:
    """From now on a renderer takes the OpenGL context that another has left, in the same thread.

    To make one and to compile its shaders takes as long as six pictures. Call it before a renderer
    is made.
    """
    from mujoco.rendering.classic import gl_context

    spare = local()

    class Kept(gl_context.GLContext):
        def free(self) -> None:
            self.left.append(self)

        def __del__(self) -> None:
            """Its renderer, which may go first or last, frees it."""

    def take(width: int, height: int) -> Kept:
        left = spare.__dict__.setdefault("contexts", [])
        context = left.pop() if left else Kept(width, height)
        context.left = left
        return context

    gl_context.GLContext = take


if __name__ == "__main__":
    print(ensure_gl())
