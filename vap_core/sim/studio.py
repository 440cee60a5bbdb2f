"""Photographs of single objects on a plain table: the reference views of a personal object, and contact sheets."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from vap_core.errors import BadOutput
from vap_core.sim.gl import ensure_gl
from vap_core.sim.objects import ObjectModel, add_object, extent_m
from vap_core.values import Rgb, value

FOVY_DEG = 30.0


@value
class Shot:
    """Where the camera and the lamp stand: angles in radians; `fill` is the object's share of the frame; `table` is sRGB 0..1."""

    azimuth: float
    elevation: float
    fill: float = 0.55
    lamp: float = 0.6
    bright: float = 0.7
    table: tuple[float, float, float] = (0.62, 0.58, 0.53)


def photograph(model: ObjectModel, shots: Sequence[Shot], size: int = 320) -> list[Rgb]:
    """One picture, size x size, per shot; azimuth 0 looks at the object's front."""
    ensure_gl()
    import mujoco

    x, y, z = extent_m(model)
    radius = 0.5 * max(z, float(np.hypot(x, y)))
    pictures = []
    for shot in shots:
        spec = mujoco.MjSpec()
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse, spec.visual.headlight.specular = [0.38] * 3, [0.12] * 3, [0] * 3
        spec.visual.global_.offwidth = spec.visual.global_.offheight = size
        spec.visual.quality.shadowsize = 2048
        spec.visual.map.znear, spec.visual.map.zfar = 0.01, 20.0
        spec.visual.map.shadowclip = 0.3
        spec.stat.extent, spec.stat.center = 1.0, (0, 0, 0)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(8, 8, 0.1), rgba=(*shot.table, 1))
        lamp = np.array([np.sin(shot.lamp), -np.cos(shot.lamp), 1.6])
        spec.worldbody.add_light(
            pos=0.8 * lamp, dir=-lamp, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=[shot.bright] * 3, specular=[0.2] * 3, castshadow=True
        )
        add_object(spec, model)
        compiled = spec.compile()
        data = mujoco.MjData(compiled)
        mujoco.mj_forward(compiled, data)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = 0, 0, 0.48 * z
        camera.azimuth, camera.elevation = 90 + np.degrees(shot.azimuth), -np.degrees(shot.elevation)
        camera.distance = radius / (shot.fill * np.tan(np.radians(FOVY_DEG / 2)))
        compiled.vis.global_.fovy = FOVY_DEG
        with mujoco.Renderer(compiled, size, size) as renderer:
            renderer.update_scene(data, camera)
            pictures.append(renderer.render())
    return pictures


def reference_views(model: ObjectModel, n: int = 5, seed: int = 0, size: int = 320) -> list[Rgb]:
    """K reference photos (P 3.1), as one walks around the object: azimuths evenly apart, elevations 18 to 50 degrees.

    Lamp, table and framing differ from view to view.
    """
    rng = np.random.default_rng([seed, n, *model.name.encode()])
    around = 2 * np.pi * np.arange(n) / n
    tints = rng.uniform(0.45, 0.75, (n, 1)) + rng.uniform(-0.04, 0.04, (n, 3))
    shots = [
        Shot(float(a + rng.uniform(-0.2, 0.2)), float(np.radians(rng.uniform(18, 50))), float(rng.uniform(0.52, 0.66)), float(rng.uniform(-1.2, 1.2)),
             float(rng.uniform(0.5, 0.75)), (float(red), float(green), float(blue)))
        for a, (red, green, blue) in zip(rng.permutation(around), tints, strict=True)
    ]  # fmt: skip
    return photograph(model, shots, size)


def write_views(model: ObjectModel, folder: Path, n: int = 5) -> list[Path]:
    """Reference photos as `<name>-<i>.png`. Raises: BadOutput."""
    paths = [folder / f"{model.name}-{i}.png" for i in range(n)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, rgb in zip(paths, reference_views(model, n), strict=True):
            Image.fromarray(rgb).save(path)
    except OSError as error:
        raise BadOutput(f"photograph: {folder} cannot be written ({error.strerror}); choose another folder with --out.") from error
    return paths


def contact_sheet(models: Sequence[ObjectModel], columns: int = 5, size: int = 200, shot: Shot | None = None) -> Rgb:
    """One picture per model, row by row."""
    shot = shot or Shot(0.45, 0.4, 0.8)
    rows = -(-len(models) // columns)
    sheet = Image.new("RGB", (columns * size, rows * size), (255, 255, 255))
    for i, model in enumerate(models):
        sheet.paste(Image.fromarray(photograph(model, [shot], size)[0]), (i % columns * size, i // columns * size))
    return np.asarray(sheet)
