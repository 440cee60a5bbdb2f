"""Meshes as scans hold them: a textured mug, and a coloured box."""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 64\n%%EndComments\nshowpage\n%%EOF\n"
"""A picture that Pillow alone draws by starting Ghostscript."""
RED, BLUE = (204, 40, 40), (30, 60, 170)


def mug(n: int = 24, rows: int = 5) -> trimesh.Trimesh:
    """A hollow mug, 9 cm tall and 7 cm wide, y up as glTF has it: its lower half blue, its upper half red outside and inside."""
    up, down = np.linspace(0, 0.09, rows), np.linspace(0.09, 0.01, rows)
    profile = [(0, 0), *((0.035, z) for z in up), *((0.029, z) for z in down), (0, 0.01)]
    radius, z = np.array(profile).T
    turn = 2 * np.pi * np.arange(n + 1) / n
    turn[-1] = 0
    grid = np.stack(
        [
            radius[:, None] * np.cos(turn),
            np.broadcast_to(z[:, None], (len(z), n + 1)),
            -radius[:, None] * np.sin(turn),
        ],
        axis=-1,
    )
    uv = np.stack(np.broadcast_arrays(np.arange(n + 1) / n, z[:, None] / 0.09), axis=-1)
    start = (np.arange(len(z) - 1)[:, None] * (n + 1) + np.arange(n)).ravel()
    step = n + 1
    face = np.concatenate(
        [
            np.stack([start, start + 1, start + step + 1], 1),
            np.stack([start, start + step + 1, start + step], 1),
        ]
    )
    picture = np.zeros((256, 256, 3), np.uint8)
    picture[:128], picture[128:] = RED, BLUE
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    visual = trimesh.visual.TextureVisuals(uv=uv.reshape(-1, 2), material=material)
    return trimesh.Trimesh(grid.reshape(-1, 3), face, visual=visual, process=False)


def box(**look) -> trimesh.Trimesh:
    solid = trimesh.creation.box((0.06, 0.05, 0.08))
    if look:
        solid.visual.vertex_colors = np.tile([*look["rgb"], 255], (8, 1)).astype(np.uint8)
    return solid


def put(folder: Path, name: str, mesh: trimesh.Trimesh | trimesh.Scene) -> Path:
    mesh.export(folder / name)
    return folder / name


def fake_ghostscript(folder: Path, monkeypatch) -> Path:
    """Puts a program named gs first in PATH; the file that it writes when it is started."""
    marker = folder / "gs-was-started"
    program = folder / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\necho \"$@\" >> '{marker}'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=":")
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_binary", None)
    return marker
