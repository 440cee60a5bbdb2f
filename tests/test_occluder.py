"""The controlled occluder: it hides completely, only where and when it is told to, and is nowhere but in the picture."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from vap_core.base.errors import UnknownName
from vap_core.policies.scripted.expert import Expert
from vap_core.simulation import suites
from vap_core.simulation.env import Env
from vap_core.simulation.occluder import Occlusion
from vap_core.simulation.scenes import Scene, build
from vap_core.simulation.types import EpisodeRow

ALWAYS = 10**6
SUITE = suites.TABLETOP


@pytest.fixture(scope="module")
def row() -> EpisodeRow:
    return suites.rows("tabletop", "put-scrubber", 4)[1]


@pytest.fixture(scope="module")
def scene(row: EpisodeRow) -> Iterator[Scene]:
    with build(SUITE.robot, [place.model for place in row.placements]) as built:
        yield built


def env_of(scene: Scene, occlusion: Occlusion | None = None) -> Env:
    return Env(
        scene,
        cameras=SUITE.cameras,
        control=SUITE.control,
        sensor=SUITE.sensor,
        occlusion=occlusion,
    )


def drive(env: Env, row: EpisodeRow, steps: int) -> Iterator[int]:
    """The expert's episode, one control step after the other."""
    expert = Expert()
    env.reset(row)
    state = expert.start(np.random.default_rng(0))
    for step in range(steps):
        yield step
        (state,), (chunk,) = expert.plan_from_simulation([state], [env])
        env.step(chunk[0])


def test_plates_hide_all_and_arms_most_of_the_target_through_a_whole_episode(
    scene: Scene, row: EpisodeRow
) -> None:
    plain, plate, arm = (
        env_of(scene),
        env_of(scene, Occlusion(0, ALWAYS)),
        env_of(scene, Occlusion(0, ALWAYS, "arm")),
    )
    compared, wrist = 0, 0
    for step in drive(plain, row, 180):
        if step % 12 == 0:
            plate.restore(plain.snapshot())
            arm.restore(plain.snapshot())
            free, behind, partly = (env.truth(masks=True).masks for env in (plain, plate, arm))
            for camera in SUITE.cameras:
                assert not behind[camera][row.target].any()
                area = int(free[camera][row.target].sum())
                assert int(partly[camera][row.target].sum()) <= 0.2 * area
                assert all(
                    (behind[camera][name] <= free[camera][name]).all() for name in free[camera]
                )  # nothing shows through or anew
                compared += area >= 100
                wrist += camera == "wrist" and area > 5000
    assert compared >= 30  # the target did show
    assert wrist >= 3  # and filled the wrist camera's view when it was carried


def test_it_is_drawn_in_its_camera_and_its_steps_alone_and_leaves_no_other_trace(
    scene: Scene, row: EpisodeRow
) -> None:
    plain, hidden = env_of(scene), env_of(scene, Occlusion(2, 3, cameras=("side",)))
    for env in (plain, hidden):
        env.reset(row)
    action = np.full(plain.action_size, 0.01, np.float32)
    for step in range(7):
        one, other = plain.observe(), hidden.observe()
        for camera in SUITE.cameras:
            assert np.array_equal(one.images[camera], other.images[camera]) == (
                camera != "side" or not 2 <= step < 5
            )
        assert np.array_equal(plain.snapshot().state, hidden.snapshot().state)
        assert (one.images["side"] != other.images["side"]).any(
            axis=2
        ).mean() < 0.05  # a plate of the target's size, no curtain
        for env in (plain, hidden):
            env.step(action)


def test_the_same_occlusion_is_the_same_picture_and_arms_differ_from_episode_to_episode(
    scene: Scene, row: EpisodeRow
) -> None:
    def look(episode: int) -> np.ndarray:
        env = Env(scene, cameras=("front",), occlusion=Occlusion(0, 1, "arm"))
        env.reset(replace(row, episode=episode))
        return env.observe().images["front"]

    assert np.array_equal(look(3), look(3))
    assert not np.array_equal(look(3), look(4))


def test_a_target_out_of_the_picture_needs_no_occluder(scene: Scene, row: EpisodeRow) -> None:
    far = replace(row, placements=(replace(row.placements[0], x=-0.2, y=0.55), *row.placements[1:]))
    pictures = []
    for occlusion in (None, Occlusion(0, 1)):
        env = Env(scene, cameras=("side",), occlusion=occlusion)
        env.reset(far)
        assert not env.truth(masks=True).masks["side"][row.target].any()
        pictures.append(env.observe().images["side"])
    assert np.array_equal(*pictures)


@pytest.mark.parametrize("size", [(180, 320), (320, 180)])
def test_a_plate_hides_all_in_views_that_are_not_square(
    scene: Scene, row: EpisodeRow, size: tuple[int, int]
) -> None:
    height, width = size
    beyond_the_square = 0
    for y in np.linspace(-0.4, 0.4, 17).tolist():
        target = replace(row.placements[0], x=0.25, y=y)
        masks = []
        for occlusion in (None, Occlusion(0, 1)):
            env = Env(scene, image_size=size, cameras=("front", "side"), occlusion=occlusion)
            env.reset(replace(row, placements=(target, *row.placements[1:])))
            masks.append(env.truth(masks=True).masks)
        free, behind = masks
        for camera in ("front", "side"):
            seen = free[camera][row.target]
            rim = (width - height) // 2
            if rim > 0 and (seen[:, :rim].any() or seen[:, width - rim :].any()):
                beyond_the_square += 1
            assert not behind[camera][row.target].any()
    assert beyond_the_square >= 4 or width < height


def test_an_unknown_camera_is_named(scene: Scene) -> None:
    with pytest.raises(UnknownName, match="camera of the occlusion.*front"):
        env_of(scene, Occlusion(0, 1, cameras=("rear",)))
