"""Demonstrations as a LeRobotDataset: lerobot reads them, they come back bit for bit, and no interruption loses or doubles one."""

import json
import multiprocessing
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vap_core.base.errors import BadOutput
from vap_core.simulation.assets import objects
from vap_core.simulation.suites import Suite, suite
from vap_make.films import dataset
from vap_make.films.dataset import (
    ABOUT,
    MOST,
    about,
    data_sha256,
    film_sha256,
    generic_instruction,
    read,
    write,
)
from vap_make.films.demonstrations import PARTS, Film, after_a_miss, cached
from vap_make.policy.batches import STEADY, statistics
from vap_make.recipe import FILMED, filmed_tasks

SUITE, SIDE, STAGES = "simpler-bridge", 64, 4
SHIPPED = Path(__file__).parent.parent / "data" / "demonstrations"


@pytest.fixture(autouse=True)
def _tables(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """What Hugging Face's datasets keep beside the tables that they read is the tests' own."""
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", tmp_path_factory.mktemp("tables"))


def invented(rng: np.random.Generator) -> Film:
    """A film of noise and of a square that moves: the smallest that has every part."""
    steps, things = int(rng.integers(2, 7)), int(rng.integers(2, MOST + 1))
    images = np.repeat(rng.integers(0, 256, (1, 1, SIDE, SIDE, 3), np.uint8), steps, 0)
    ids = np.zeros((steps, 1, SIDE, SIDE), np.uint8)
    for t in range(steps):
        x, y = rng.integers(0, SIDE - 8, 2)
        images[t, 0, y : y + 8, x : x + 8] = rng.integers(0, 256, 3, np.uint8)
        ids[t, 0, y : y + 8, x : x + 8] = rng.integers(1, things + 1)
    task = filmed_tasks(SUITE)[int(rng.integers(4))]
    numbers = [rng.normal(size=(steps, n)).astype(np.float32) for n in (13, 7)]
    places = rng.normal(size=(steps, things, 3)).astype(np.float32)
    return Film(
        images,
        ids,
        *numbers,
        places,
        tuple(f"thing-{i}" for i in range(things)),
        task.name,
        things - 1 if task.goal else -1,
    )


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Filmed stages, as `cached` keeps them; one of them without a film."""
    folder, rng = tmp_path_factory.mktemp("cache"), np.random.default_rng(0)
    for stage, n in enumerate((2, 0, 1, 2)):
        films = {
            f"{part}{i}": getattr(film, part)
            for i, film in enumerate([invented(rng) for _ in range(n)])
            for part in PARTS
        }
        np.savez(folder / f"{SUITE}-0-{stage:05d}.npz", n=n, cpu_s=1.5, **films)
    return folder


@pytest.fixture(scope="module")
def films(cache: Path) -> list[Film]:
    return [film for stage in range(STAGES) for film in cached(cache, SUITE, 0, stage)]


@pytest.fixture(scope="module")
def written(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written") / "out"
    before = set(threading.enumerate())
    write(SUITE, STAGES, folder, cache=cache, part=2)
    assert multiprocessing.active_children() == []
    assert {type(thread).__name__ for thread in set(threading.enumerate()) - before} <= {
        "TMonitor"
    }, "tqdm's own is a daemon of the process"
    return folder


def alike(some: list[Film], others: list[Film]) -> bool:
    """Bit for bit, shapes and types too."""
    return len(some) == len(others) and all(
        np.array_equal(a, b) and np.asarray(a).dtype == np.asarray(b).dtype
        for one, other in zip(some, others, strict=True)
        for a, b in ((getattr(one, part), getattr(other, part)) for part in PARTS)
    )


def test_films_come_back_bit_for_bit(written: Path, films: list[Film], cache: Path) -> None:
    assert alike(read(written), films)
    assert alike(read(written, lambda stage: stage % 2 == 0), films[:3])
    assert about(written)["data_sha256"] == data_sha256(films)
    assert [one["stage"] for one in about(written)["episodes"]] == [0, 0, 2, 3, 3]
    assert not {path.name for path in written.iterdir()} - {
        ".lock",
        "run.json",
        "data",
        "videos",
        "meta",
    }


def test_so_do_those_with_fewer_pictures_than_steps(
    films: list[Film], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(FILMED, SUITE, replace(FILMED[SUITE], every=3))
    fewer = [replace(film, images=film.images[::3], ids=film.ids[::3]) for film in films]
    kept = {f"{part}{i}": getattr(film, part) for i, film in enumerate(fewer) for part in PARTS}
    np.savez(tmp_path / f"{SUITE}-0-00000.npz", n=len(fewer), **kept)
    write(SUITE, 1, tmp_path / "out", cache=tmp_path)
    assert alike(read(tmp_path / "out"), fewer)
    repeated = [
        replace(
            film,
            images=film.images.repeat(3, 0)[: len(film.action)],
            ids=film.ids.repeat(3, 0)[: len(film.action)],
        )
        for film in fewer
    ]
    through_lerobot(tmp_path / "out", repeated)


def test_the_checksum_is_of_the_content_alone(
    written: Path, films: list[Film], cache: Path, tmp_path: Path
) -> None:
    parts = write(SUITE, STAGES, tmp_path / "other", cache=cache, part=1)
    assert parts["data_sha256"] == about(written)["data_sha256"] == data_sha256(iter(films))
    one = films[0]
    again = replace(one, state=np.asfortranarray(one.state), places=one.places[::-1][::-1])
    assert film_sha256(again) == film_sha256(one)
    assert data_sha256(films[::-1]) != data_sha256(films)
    touched = one.images.copy()
    touched[-1, -1, -1, -1, -1] ^= 1
    changes = (
        {"images": touched}, {"goal": one.goal + 1}, {"names": (*one.names[:-1], "x")}, {"task": "pick"}, {"action": -one.action},
        {"places": np.nextafter(one.places, np.float32(9))}, {"state": one.state[:, :-1]}, {"ids": one.ids ^ 1},
    )  # fmt: skip
    assert {part for change in changes for part in change} == set(PARTS)
    assert (
        len({film_sha256(one), *(film_sha256(replace(one, **change)) for change in changes)})
        == len(changes) + 1
    )


def test_lerobot_reads_frames_tasks_and_statistics(written: Path, films: list[Film]) -> None:
    through_lerobot(written, films)


def through_lerobot(folder: Path, films: list[Film]) -> None:
    """lerobot's own class gives every frame of these films, its own statistics are ours, and a policy would see no masks and no places."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.feature_utils import dataset_to_policy_features

    held = about(folder)
    known = suite(held["suite"])
    found = LeRobotDataset(f"vap/{known.name}", folder, video_backend="pyav")
    assert (found.meta.total_episodes, found.meta.total_frames) == (
        len(films),
        sum(len(film.action) for film in films),
    )
    assert (found.fps, found.meta.robot_type) == (known.hz, known.robot)
    views = {f"observation.images.{camera}" for camera in known.cameras}
    assert set(dataset_to_policy_features(found.features)) == {
        *views,
        "observation.state",
        "action",
    }
    assert all(
        len(found.features[name]["names"]) == found.features[name]["shape"][0]
        for name in ("observation.state", "action", "vap.places")
    )
    frames = [
        (film, t, episode) for episode, film in enumerate(films) for t in range(len(film.action))
    ]
    for i in range(0, len(frames), max(1, len(frames) // 25)):
        film, t, episode = frames[i]
        frame = found[i]
        assert (frame["episode_index"], frame["frame_index"], frame["task"]) == (
            episode,
            t,
            generic_instruction(known, film.task),
        )
        for c, camera in enumerate(known.cameras):
            seen = (
                (frame[f"observation.images.{camera}"].permute(1, 2, 0) * 255)
                .round()
                .to(torch.uint8)
            )
            assert np.array_equal(seen.numpy(), film.images[t, c])
        assert np.array_equal(frame["observation.state"].numpy(), film.state[t])
        assert np.array_equal(frame["action"].numpy(), film.action[t])
        assert np.array_equal(
            frame["vap.places"].numpy().reshape(-1, 3)[: len(film.names)], film.places[t]
        )
    written = json.loads((folder / "meta" / "stats.json").read_text())
    for name, ours in statistics(films).items():
        rows = np.concatenate(
            [film.state if name == "observation.state" else film.action for film in films]
        )
        assert written[name]["count"] == [len(rows)]
        np.testing.assert_allclose(written[name]["mean"], ours["mean"], rtol=1e-4, atol=1e-5)
        steady = rows.std(0) > STEADY * max(1e-3, float(rows.std()))
        assert steady.sum() >= 5
        np.testing.assert_allclose(
            np.array(written[name]["std"])[steady], ours["std"].numpy()[steady], rtol=1e-3
        )


def test_tasks_are_said_of_anybodys_thing() -> None:
    assert generic_instruction(suite(SUITE), "pick-shaver") == "pick up the shaver"
    assert (
        generic_instruction(suite("simpler-fractal"), "move-vase-near-coke-can")
        == "move the vase near coke can"
    )


def test_a_killed_writing_goes_on_and_neither_loses_nor_doubles(
    cache: Path, films: list[Film], written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    ask = f"write({SUITE!r}, {STAGES}, Path({str(out)!r}), cache=Path({str(cache)!r}), part=1)"
    code = f"from pathlib import Path; from vap_make.films.dataset import write; {ask}"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    first = out / "parts" / "00000-00001"
    while not first.exists():
        assert process.poll() is None
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (out / ABOUT).exists(), "it was killed before its end"
    with pytest.raises(
        BadOutput, match="half-written demonstrations; run the command that began it again"
    ):
        read(out)
    kept, seen = (first / "meta" / "info.json").stat().st_ino, []
    joining = dataset._join

    def join(known: Suite, recipe: dict[str, Any], folders: list[Path], out: Path) -> None:
        seen.append((folders[0] / "meta" / "info.json").stat().st_ino)
        joining(known, recipe, folders, out)

    monkeypatch.setattr(dataset, "_join", join)
    made = write(SUITE, STAGES, out, cache=cache, part=1)
    assert seen == [kept], "what was whole is not written again"
    assert made["episodes"] == about(written)["episodes"]
    assert alike(read(out), films)


def test_a_joining_cut_short_is_done_again(
    cache: Path, films: list[Film], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, moving = tmp_path / "out", dataset.os.replace

    def torn(source: Path, target: Path) -> None:
        if Path(target) == out / "meta":
            raise KeyboardInterrupt
        moving(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(dataset.os, "replace", torn)
        with pytest.raises(KeyboardInterrupt):
            write(SUITE, STAGES, out, cache=cache, part=4)
    assert (out / "videos").exists()
    assert not (out / ABOUT).exists()
    write(SUITE, STAGES, out, cache=cache, part=4)
    assert alike(read(out), films)
    assert not (out / ".whole").exists()


def test_a_whole_one_is_left_alone_and_another_recipe_refused(written: Path, cache: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in written.rglob("*")}
    assert write(SUITE, STAGES, written, cache=cache) == about(written)
    assert {path: path.stat().st_mtime_ns for path in written.rglob("*")} == before
    for stages, seed, told in (
        (STAGES + 1, 0, "stages 4 there, 5 now"),
        (STAGES, 3, "seed 0 there, 3 now"),
    ):
        with pytest.raises(BadOutput, match=f"holds another run .{told}"):
            write(SUITE, stages, written, cache=cache, seed=seed)


def test_no_film_at_all_is_said(cache: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / f"{SUITE}-0-00000.npz", n=0)
    with pytest.raises(BadOutput, match="no film of .* succeeded; ask for more stages"):
        write(SUITE, 1, tmp_path / "out", cache=tmp_path)


def test_an_encoder_that_changes_pixels_is_found_out(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lossy = dataset.CODEC["extra_options"]["x265-params"].replace("lossless=1", "lossless=0")
    monkeypatch.setattr(
        dataset, "CODEC", {**dataset.CODEC, "crf": 40, "extra_options": {"x265-params": lossy}}
    )
    with pytest.raises(
        BadOutput,
        match="parts/00000-0000. was not written as it was filmed .ValueError: episode 0 is not what its checksum says",
    ):
        write(SUITE, STAGES, tmp_path / "out", cache=cache)
    assert not [
        path for path in (tmp_path / "out" / "parts").iterdir() if not path.name.startswith(".")
    ]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def put(path: Path, **new: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **new}))


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (
            shutil.rmtree,
            "holds no demonstrations; make them with: ./vap train demonstrations",
        ),
        (lambda f: cut(f / "data/chunk-000/file-000.parquet"), "is damaged .ArrowInvalid"),
        (lambda f: cut(f / "meta/episodes/chunk-000/file-000.parquet"), "is damaged .ArrowInvalid"),
        (
            lambda f: cut(f / "videos/observation.images.front/chunk-000/file-000.mp4"),
            "is damaged .BadPhoto",
        ),
        (
            lambda f: (f / "videos/observation.images.front/chunk-000/file-000.mp4").unlink(),
            "is damaged .BadPhoto",
        ),
        (lambda f: (f / "data/chunk-000/file-000.parquet").unlink(), "is damaged"),
        (lambda f: (f / ABOUT).write_text("{"), "absent or damaged .JSONDecodeError"),
        (lambda f: (f / "meta/info.json").unlink(), "absent or damaged .FileNotFoundError"),
        (lambda f: put(f / ABOUT, suite=None), "absent or damaged .TypeError"),
        (lambda f: put(f / ABOUT, episodes=None), "absent or damaged .TypeError"),
        (lambda f: put(f / ABOUT, stages="2"), "absent or damaged .TypeError"),
        (lambda f: (f / ABOUT).write_text('{"version": 1}'), "absent or damaged .KeyError"),
        (lambda f: put(f / ABOUT, version=2), "version 2 of a LeRobotDataset v3.0, not 1 of v3.0"),
        (
            lambda f: put(f / "meta/info.json", codebase_version="v2.1"),
            "version 1 of a LeRobotDataset v2.1, not 1 of v3.0",
        ),
        (lambda f: put(f / ABOUT, episodes=about(f)["episodes"][1:]), "is damaged .ValueError"),
        (
            lambda f: put(f / ABOUT, episodes=[{**one, "goal": 5} for one in about(f)["episodes"]]),
            "episode 0 is not what its checksum says",
        ),
    ],
)
def test_what_is_damaged_is_one_line_with_its_mend(
    written: Path, tmp_path: Path, harm, told: str
) -> None:
    folder = tmp_path / "harmed"
    shutil.copytree(written, folder)
    harm(folder)
    with pytest.raises(BadOutput, match=told) as caught:
        read(folder)
    assert "\n" not in str(caught.value)
    assert "train demonstrations" in str(caught.value)


@pytest.mark.parametrize("name", ["simpler-bridge"])
def test_the_shipped_ones_are_generic_and_whole(name: str) -> None:
    folder = SHIPPED / name
    films, held = read(folder), about(folder)
    assert data_sha256(films) == held["data_sha256"]
    manifest = json.loads((SHIPPED / "manifest.json").read_text())
    assert manifest[name] == {
        "episodes": len(films),
        "frames": sum(len(film.action) for film in films),
        "sha256": held["data_sha256"],
    }
    for film in films:
        assert {
            objects.get_object(thing).split for i, thing in enumerate(film.names) if i != film.goal
        } == {"generic"}
        seen = (film.ids == 1).sum((1, 2, 3))
        assert (seen.max() if after_a_miss(film) else seen[0]) > 20, (
            "the target is in view; a hand that missed may hide it at first"
        )
    assert held["data_sha256"] in (SHIPPED / "README.md").read_text()
    through_lerobot(folder, films)


def test_the_shipped_ones_are_small() -> None:
    assert {path.name for path in SHIPPED.iterdir()} == {
        "README.md",
        "manifest.json",
        "simpler-bridge",
    }
    assert sum(path.stat().st_size for path in SHIPPED.rglob("*") if path.is_file()) < 1.8e6


@pytest.mark.slow
def test_what_is_missing_is_filmed(tmp_path: Path) -> None:
    made = write("simpler-fractal", 1, tmp_path / "out", cache=tmp_path / "cache", seed=7, jobs=1)
    assert made["episodes"]
    assert alike(read(tmp_path / "out"), cached(tmp_path / "cache", "simpler-fractal", 7, 0))
