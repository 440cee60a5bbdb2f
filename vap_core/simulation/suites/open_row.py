"""From an episode row to a scene and an environment: with its suite, variant and objects."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from vap_core.simulation.assets.objects import ObjectModel
from vap_core.simulation.env import Env
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.scenes import Meshes, Scene, build
from vap_core.simulation.suites import suite as suite_called
from vap_core.simulation.suites.suite import VARIANTS
from vap_core.simulation.types import EpisodeRow


def build_scene(
    suite: str,
    models: Sequence[str | ObjectModel],
    variant: str = "base",
    meshes: Meshes = "plain",
) -> Scene:
    """The suite's robot and cameras with `models`, in a variant's style.

    `models` are names in the object registry, or models themselves. Raises: UnknownName.
    """
    robot = suite_called(suite).robot
    return build(robot, models, style=VARIANTS[variant].style, meshes=meshes)


def models_of(rows: Iterable[EpisodeRow]) -> list[str]:
    """The objects that rows place, in the order of their first places."""
    return list(dict.fromkeys(place.model for row in rows for place in row.placements))


def make_env(
    scene: Scene,
    suite: str,
    *,
    image_size: int | tuple[int, int] = 224,
    cameras: Sequence[str] | None = None,
    occlusion: Occlusion | None = None,
) -> Env:
    """An environment in `scene` with the suite's control and sensors, and (some of) its cameras."""
    known = suite_called(suite)
    return Env(
        scene,
        image_size=image_size,
        cameras=known.cameras if cameras is None else cameras,
        control=known.control,
        sensor=known.sensor,
        occlusion=occlusion,
    )


def cameras_of(row: EpisodeRow) -> tuple[str, ...]:
    """The views of the row's episode: the row's own, or its suite's where it names none.

    Raises: UnknownName, for the suite of a row that names none.
    """
    return row.cameras or suite_called(row.suite).cameras


@contextmanager
def open_row(
    row: EpisodeRow,
    *,
    image_size: int | tuple[int, int] = 224,
    occlusion: Occlusion | None = None,
    meshes: Meshes = "plain",
) -> Iterator[Env]:
    """An environment at the start of the row's episode; its scene is closed with the block.

    Raises: UnknownName, for a suite, an object or a camera that does not exist.
    """
    models = [place.model for place in row.placements]
    with build_scene(row.suite, models, row.variant, meshes) as scene:
        env = make_env(
            scene, row.suite, image_size=image_size, cameras=cameras_of(row), occlusion=occlusion
        )
        env.reset(row)
        yield env
