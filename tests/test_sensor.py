"""The sensor model: a perfect camera changes nothing; a desk's noise, gain and knocks are the specified ones, drawn from the episode alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vap_core.simulation import scenes
from vap_core.simulation.assets import objects
from vap_core.simulation.cameras import project
from vap_core.simulation.env import Env
from vap_core.simulation.looks import PERFECT, WEBCAM, Sensor, apply_sensor, draw_disturbance
from vap_core.simulation.types import EpisodeRow, Placement

MODEL = "cup-personal"
ROW = EpisodeRow(
    "tabletop",
    "select-cup",
    3,
    0,
    "select my cup",
    "cup",
    (Placement(MODEL, 0.22, 0.0, 0.4),),
    150,
    "selected",
)
EPISODES = [replace(ROW, episode=i, seed=j) for j in range(4) for i in range(250)]
GREY = np.full((224, 224, 3), 120, np.uint8)


@pytest.fixture(scope="module")
def scene():
    with scenes.build("so101", [MODEL]) as built:
        yield built


def env(scene, sensor, row=ROW, image_size=224):
    made = Env(
        scene, sensor=sensor, image_size=image_size, cameras=("front", "side"), control="joint"
    )
    made.reset(row)
    return made


def test_a_perfect_sensor_changes_nothing(scene):
    still = draw_disturbance(PERFECT, ROW, "front")
    assert apply_sensor(PERFECT, GREY, still, ROW, "front", 0) is GREY
    assert (still.shift_m == 0).all()
    assert (still.turn == np.eye(3)).all()
    assert (still.gain == 1).all()
    plain = env(scene, PERFECT)
    elsewhere = env(scene, PERFECT, replace(ROW, episode=8, seed=2))
    for name, rgb in plain.observe().images.items():
        assert (elsewhere.observe().images[name] == rgb).all()
    zero = env(scene, Sensor())
    assert all(
        (zero.observe().images[name] == rgb).all() for name, rgb in plain.observe().images.items()
    )


def test_the_same_row_gives_the_same_picture_and_another_episode_or_seed_another(scene):
    one, again = env(scene, WEBCAM).observe().images, env(scene, WEBCAM).observe().images
    assert all((again[name] == rgb).all() for name, rgb in one.items())
    for other in (replace(ROW, episode=4), replace(ROW, seed=1), replace(ROW, task="select-vase")):
        seen = env(scene, WEBCAM, other).observe().images
        assert all((seen[name] != rgb).mean() > 0.5 for name, rgb in one.items())


def test_looking_twice_is_seeing_the_same_and_every_step_has_its_own_grain(scene):
    desk = env(scene, Sensor(noise=2.5), image_size=64)
    desk.step(np.array([0, 0, 0, 0, 0, 1], np.float32))
    first = desk.observe().images["front"]
    assert (desk.observe().images["front"] == first).all()
    desk.step(np.array([0, 0, 0, 0, 0, 1], np.float32))
    difference = desk.observe().images["front"].astype(float) - first
    assert np.median(np.abs(difference)) > 0
    assert np.std(difference) == pytest.approx(2.5 * np.sqrt(2), rel=0.1)


def test_cameras_of_one_episode_stray_each_its_own_way():
    front, side = (draw_disturbance(WEBCAM, ROW, name) for name in ("front", "side"))
    assert not np.allclose(front.shift_m, side.shift_m)
    assert not np.allclose(front.gain, side.gain)


def test_noise_and_gain_of_a_picture_are_the_specified_ones():
    disturbance = draw_disturbance(WEBCAM, ROW, "front")
    seen = apply_sensor(WEBCAM, GREY, disturbance, ROW, "front", 0).astype(float)
    expected_sd = np.sqrt(WEBCAM.noise**2 + 1 / 12)  # rounding to whole grey levels adds a twelfth
    n = GREY[..., 0].size
    for channel in range(3):
        values = seen[..., channel]
        assert values.mean() == pytest.approx(
            120 * disturbance.gain[channel], abs=4 * expected_sd / np.sqrt(n)
        )
        assert values.std() == pytest.approx(expected_sd, rel=4 / np.sqrt(2 * n))
    grain = seen - seen.mean(axis=(0, 1))
    assert abs(np.corrcoef(grain[..., 0].ravel(), grain[..., 1].ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(grain[:, :-1].ravel(), grain[:, 1:].ravel())[0, 1]) < 0.02


def test_black_and_white_stay_within_bounds():
    disturbance = replace(draw_disturbance(WEBCAM, ROW, "front"), gain=np.array([1.5, 1.0, 0.5]))
    for level in (0, 255):
        seen = apply_sensor(
            WEBCAM, np.full((64, 64, 3), level, np.uint8), disturbance, ROW, "front", 0
        )
        assert seen.dtype == np.uint8
        assert abs(float(np.median(seen[..., 1])) - level) <= 2


def test_over_many_episodes_the_spreads_are_the_specified_ones():
    """A sample's standard deviation is within 4 / sqrt(2 n) of the true one, and its mean within 4 / sqrt(n) of zero."""
    drawn = [draw_disturbance(WEBCAM, row, "front") for row in EPISODES]
    shift = np.array([one.shift_m for one in drawn])
    turn = np.array([Rotation.from_matrix(one.turn).as_rotvec() for one in drawn])
    gain = np.array([one.gain for one in drawn])
    n = len(EPISODES)
    for values, spread in (
        *((shift[:, k], WEBCAM.jitter_m) for k in range(3)),
        *((turn[:, k], WEBCAM.jitter_rad) for k in range(3)),
        (np.log2(gain[:, 1]), WEBCAM.exposure),
        (gain[:, 0] / gain[:, 1] - 1, WEBCAM.balance),
        (gain[:, 2] / gain[:, 1] - 1, WEBCAM.balance),
    ):
        assert values.std() == pytest.approx(spread, rel=4 / np.sqrt(2 * n))
        assert abs(values.mean()) < 4 * spread / np.sqrt(n)
    together = np.corrcoef(np.column_stack([shift, turn, np.log2(gain[:, 1])]).T)
    assert np.abs(together - np.eye(7)).max() < 0.13


def centre(truth, camera):
    rows, columns = np.nonzero(truth.masks[camera][MODEL])
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


def middle(truth):
    """A point in the middle of the cup, metres in the world."""
    return truth.objects_world[MODEL][None, :3] + [
        [0, 0, objects.extent_m(objects.get_object(MODEL))[2] / 2]
    ]


@pytest.mark.parametrize(
    "sensor",
    [WEBCAM, Sensor(jitter_m=0.03), Sensor(jitter_rad=0.1)],
    ids=["desk", "shifted", "turned"],
)
def test_the_reported_camera_is_the_one_that_took_the_picture(sensor, scene):
    """Wherever the camera strays, the cup is rendered where the reported camera projects it."""
    usual = env(scene, PERFECT)
    truth = usual.truth(masks=True)
    offset = {
        cam.name: centre(truth, cam.name) - project(cam, middle(truth))[0]
        for cam in usual.cameras()
    }
    moved = []
    for episode in range(6):
        disturbance = env(scene, sensor, replace(ROW, episode=episode))
        seen = disturbance.truth(masks=True)
        for cam, home in zip(disturbance.cameras(), usual.cameras(), strict=True):
            assert centre(seen, cam.name) - project(cam, middle(seen))[0] == pytest.approx(
                offset[cam.name], abs=1.0
            )
            moved.append(np.linalg.norm(centre(seen, cam.name) - centre(truth, cam.name)))
            assert (
                np.linalg.norm(cam.pose_world[:3, 3] - home.pose_world[:3, 3])
                <= 4 * sensor.jitter_m + 1e-9
            )
            assert cam.k == pytest.approx(home.k)
    assert max(moved) > 2.0


def test_a_knock_moves_a_point_by_focal_length_over_distance(scene):
    """Small angles: a turn moves the picture by f times the angle, a shift across by f times the shift over the distance."""
    home = env(scene, PERFECT).cameras()[0]
    focal, ahead = home.k[0, 0], home.pose_world[:3, :3] @ np.array([0.0, 0.0, 0.4])
    point = (home.pose_world[:3, 3] + ahead)[None]
    for episode in range(5):
        row = replace(ROW, episode=episode)
        turned = env(scene, Sensor(jitter_rad=0.01), row).cameras()[0]
        about = Rotation.from_matrix(
            draw_disturbance(Sensor(jitter_rad=0.01), row, "front").turn
        ).as_rotvec()
        expected = focal * np.array(
            [about[1], about[0]]
        )  # OpenGL axes: y up; a turn to the left moves things right
        assert project(turned, point)[0] - project(home, point)[0] == pytest.approx(
            expected, abs=0.1
        )
        shifted = env(scene, Sensor(jitter_m=0.004), row).cameras()[0]
        shift = draw_disturbance(Sensor(jitter_m=0.004), row, "front").shift_m
        expected = focal * np.array([-shift[0], shift[1]]) / 0.4
        assert project(shifted, point)[0] - project(home, point)[0] == pytest.approx(
            expected, abs=0.1
        )


def test_a_camera_strays_once_and_then_stays(scene):
    """Neither stepping, nor restoring a snapshot, nor looking lets the knocks add up."""
    desk = env(scene, WEBCAM)
    first, kept = [cam.pose_world for cam in desk.cameras()], desk.snapshot()
    for _ in range(3):
        desk.observe()
        desk.step(np.array([0, 0, 0, 0, 0, 1], np.float32))
    assert all(
        (cam.pose_world == pose).all() for cam, pose in zip(desk.cameras(), first, strict=True)
    )
    desk.restore(kept)
    desk.restore(kept)
    assert all(
        (cam.pose_world == pose).all() for cam, pose in zip(desk.cameras(), first, strict=True)
    )


def test_global_seeding_changes_nothing(scene):
    np.random.seed(1)  # noqa: NPY002
    one = env(scene, WEBCAM, image_size=64).observe().images["front"]
    np.random.seed(2)  # noqa: NPY002
    assert (env(scene, WEBCAM, image_size=64).observe().images["front"] == one).all()
