"""Run as a script: CoACD's convex parts of a surface, from one .npz file into another.

It imports nothing of the package, so that it starts fast. CoACD cannot be interrupted: the system
ends this process when it has used its seconds of CPU.
"""

import resource
import sys

import numpy as np


def main(source: str, target: str, hulls: str, corners: str, seconds: str) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds)))
    import coacd

    surface = np.load(source)
    coacd.set_log_level("off")
    parts = coacd.run_coacd(
        coacd.Mesh(surface["vertex"], surface["face"]),
        threshold=0.1,
        preprocess_resolution=30,
        mcts_iterations=60,
        max_convex_hull=int(hulls),
        decimate=True,
        max_ch_vertex=int(corners),
        seed=0,
    )
    arrays = {}
    for i, (vertex, _) in enumerate(parts):
        arrays[f"part.{i:03}"] = vertex
    np.savez(target, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
