"""Convex parts that cover a body, split in a process of its own that a time limit ends."""

import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from vap_core.base.errors import BadObject
from vap_core.simulation.assets.shapes import Hull
from vap_core.simulation.assets.triangles import Faces, Vertices

HULLS, HULL_CORNERS = 16, 160
CPU_LIMIT_S, WALL_LIMIT_S = 60, 900
"""A surface that does not cross itself takes about ten seconds of CPU; a busy machine gives them
late."""
SLIVER_M3 = 1e-9
"""A convex part of less volume is dropped."""
SOLIDIFY = "give it thickness in your 3-D tool (solidify)"
SCRIPT = Path(__file__).with_name("decompose.py")


def convex_parts(vertex: Vertices, face: Faces) -> tuple[Hull, ...]:
    """Convex parts that cover the body.

    They stay inside its bounding box, so that it stands where its mesh stands.

    Raises: BadObject: no part has a volume, or the time limit passed.
    """
    hulls = []
    for corners in _split(vertex, face):
        inside = np.clip(corners, vertex.min(axis=0), vertex.max(axis=0))
        with suppress(QhullError):  # a part as flat as paper
            convex = ConvexHull(inside)
            if convex.volume > SLIVER_M3:
                hulls.append(Hull(inside[convex.vertices], float(convex.volume)))
    if not hulls:
        raise BadObject(f"objects: no convex part of this object has a volume; {SOLIDIFY}.")
    return tuple(hulls)


def _split(vertex: Vertices, face: Faces) -> list[np.ndarray]:
    """The corners of every part. Raises: BadObject."""
    with TemporaryDirectory(prefix="vap-convex-") as folder:
        source, target = Path(folder, "surface.npz"), Path(folder, "parts.npz")
        np.savez(source, vertex=vertex, face=face)
        words = [SCRIPT, source, target, HULLS, HULL_CORNERS, CPU_LIMIT_S]
        command = [sys.executable, "-I", *map(str, words)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=WALL_LIMIT_S)
        except subprocess.TimeoutExpired as error:
            raise _too_long(WALL_LIMIT_S) from error
        if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
            raise _too_long(CPU_LIMIT_S)
        if done.returncode or not target.exists():
            raise BadObject(
                "objects: the surface cannot be split into convex parts "
                f"(status {done.returncode}); remesh it in your 3-D tool."
            )
        with np.load(target) as parts:
            return [parts[name] for name in sorted(parts.files)]


def _too_long(seconds: int) -> BadObject:
    return BadObject(
        f"objects: splitting the surface into convex parts took over {seconds} s, so it most "
        "likely crosses itself; remesh or smooth it in your 3-D tool."
    )
