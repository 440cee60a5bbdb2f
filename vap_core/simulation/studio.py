"""Photographs of single objects on a plain table, such as a personal object's reference views."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import Image

from vap_core.base.files import write_files, writing
from vap_core.base.types import Mask, Rgb, value
from vap_core.simulation.assets.mujoco_object import VISUAL_GROUP, add_object
from vap_core.simulation.assets.objects import ObjectModel, extent_m
from vap_core.simulation.cameras import HIDDEN_GROUP

import mujoco  # isort: skip  (cameras has chosen a GL back end)

FOVY_DEG = 30.0


@value
class Shot:
    """Where the camera and the lamp stand; angles in radians.

    `fill` is the object's share of the frame; `table` is sRGB 0..1.
    """

    azimuth: float
    elevation: float
    fill: float = 0.55
    lamp: float = 0.6
    bright: float = 0.7
    table: tuple[float, float, float] = (0.62, 0.58, 0.53)


PORTRAIT = Shot(0.45, 0.4, 0.85, bright=0.95, table=(0.86, 0.85, 0.83))


class Stage:
    """A plain table under one lamp, which shows one of its objects at a time.

    Compiled once for all objects and shots. A context manager, because it holds a GL context.
    """

    def __init__(self, models: Sequence[ObjectModel], size: int = 160) -> None:
        self.models = {model.name: model for model in models}
        spec = mujoco.MjSpec()
        _set_up_table(spec, size)
        for model in self.models.values():
            add_object(spec, model)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, size, size)

    def __enter__(self) -> "Stage":
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def picture(self, name: str, shot: Shot = PORTRAIT) -> Rgb:
        """One object alone on the table."""
        self._show(name, shot)
        return np.ascontiguousarray(self._renderer.render())

    def box(self, name: str, shot: Shot = PORTRAIT) -> Float64[np.ndarray, "4"]:
        """The object's true outline in that picture, x0 y0 x1 y1 in pixels."""
        rows, columns = np.nonzero(self.mask(name, shot))
        corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        return np.array(corners, np.float64)

    def mask(self, name: str, shot: Shot = PORTRAIT) -> Mask:
        """The object's pixels in that picture."""
        self._show(name, shot)
        self._renderer.enable_segmentation_rendering()
        drawn = self._renderer.render()
        self._renderer.disable_segmentation_rendering()
        is_geom = drawn[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
        return is_geom & (drawn[..., 0] == self._model.geom(f"{name}/visual").id)

    def _show(self, name: str, shot: Shot) -> None:
        """Make one object visible, and place the lamp and the camera of `shot`."""
        model = self._model
        model.geom_group[:] = HIDDEN_GROUP
        model.geom("table").group = 0
        model.geom(f"{name}/visual").group = VISUAL_GROUP
        model.geom("table").rgba = (*shot.table, 1)
        lamp = np.array([np.sin(shot.lamp), -np.cos(shot.lamp), 1.6])
        model.light("lamp").pos = 0.8 * lamp
        model.light("lamp").dir = -lamp / np.linalg.norm(lamp)
        model.light("lamp").diffuse = shot.bright
        mujoco.mj_kinematics(model, self._data)
        mujoco.mj_camlight(model, self._data)
        x, y, z = extent_m(self.models[name])
        extent = max(z, float(np.hypot(x, y)))
        camera = mujoco.MjvCamera()
        camera.lookat[:] = 0, 0, 0.48 * z
        camera.azimuth = 90 + np.degrees(shot.azimuth)
        camera.elevation = -np.degrees(shot.elevation)
        camera.distance = 0.5 * extent / (shot.fill * np.tan(np.radians(FOVY_DEG / 2)))
        self._renderer.update_scene(self._data, camera)


def photograph(model: ObjectModel, shots: Sequence[Shot], size: int = 320) -> list[Rgb]:
    """One picture, size x size, per shot; azimuth 0 looks at the object's front."""
    with Stage([model], size) as stage:
        return [stage.picture(model.name, shot) for shot in shots]


def reference_views(model: ObjectModel, n: int = 5, seed: int = 0, size: int = 320) -> list[Rgb]:
    """K reference photos (P 3.1), from around the object."""
    return photograph(model, reference_shots(model, n, seed), size)


def reference_shots(model: ObjectModel, n: int, seed: int) -> list[Shot]:
    """How an object's reference photos are taken.

    Azimuths are evenly spaced, elevations 18 to 50 degrees. Lamp, table and framing differ from
    view to view.
    """
    rng = np.random.default_rng([seed, n, *model.name.encode()])
    azimuths = 2 * np.pi * np.arange(n) / n
    tints = rng.uniform(0.45, 0.75, (n, 1)) + rng.uniform(-0.04, 0.04, (n, 3))
    shots = []
    for azimuth, (red, green, blue) in zip(rng.permutation(azimuths), tints.tolist(), strict=True):
        shot = Shot(
            azimuth=float(azimuth + rng.uniform(-0.2, 0.2)),
            elevation=float(np.radians(rng.uniform(18, 50))),
            fill=float(rng.uniform(0.52, 0.66)),
            lamp=float(rng.uniform(-1.2, 1.2)),
            bright=float(rng.uniform(0.5, 0.75)),
            table=(red, green, blue),
        )
        shots.append(shot)
    return shots


def write_views(
    model: ObjectModel, folder: Path, n: int = 5, *, replace: bool = False
) -> list[Path]:
    """Reference photos as `<name>-<i>.png`.

    Raises: BadOutput when the folder cannot be written, or, without `replace`, holds other files
        of these names.
    """
    files = {}
    for i, rgb in enumerate(reference_views(model, n)):
        picture = io.BytesIO()
        Image.fromarray(rgb).save(picture, "PNG")
        files[folder / f"{model.name}-{i}.png"] = picture.getvalue()
    mend = "choose another folder with --out"
    write_files(files, "photograph", mend, replace=replace)
    return list(files)


def write_preview(model: ObjectModel, path: Path) -> None:
    """The object from its front, its side, its back and above, side by side. Raises: BadOutput."""
    shots = []
    for azimuth, elevation in ((0.0, 0.3), (np.pi / 2, 0.3), (np.pi, 0.3), (0.4, 1.2)):
        shots.append(Shot(azimuth, elevation, fill=0.75))
    picture = np.concatenate(photograph(model, shots), axis=1)
    with writing(path, "preview", "choose another folder with --out"):
        Image.fromarray(picture).save(path)


def _set_up_table(spec: mujoco.MjSpec, size: int) -> None:
    """The table and the lamp, and how they are rendered, `size` x `size` pixels."""
    headlight = spec.visual.headlight
    headlight.ambient = [0.38] * 3
    headlight.diffuse = [0.12] * 3
    headlight.specular = [0] * 3
    spec.visual.global_.offwidth = size
    spec.visual.global_.offheight = size
    spec.visual.global_.fovy = FOVY_DEG
    spec.visual.quality.shadowsize = 2048
    spec.visual.map.znear = 0.01
    spec.visual.map.zfar = 20.0
    spec.visual.map.shadowclip = 0.3
    spec.stat.extent = 1.0
    spec.stat.center = (0, 0, 0)
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(8, 8, 0.1))
    spec.worldbody.add_light(
        name="lamp",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        specular=[0.2] * 3,
        castshadow=True,
    )
