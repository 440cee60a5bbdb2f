"""A recorded LeRobotDataset is grounded, tracked, recorded and copied; what it lacks is one line."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from tests.command import refused, vap
from tests.full_disk import full_disk
from tests.scanned import EPS
from tests.test_media import LISTS, claims, film
from tests.toys import TOYS, SameColour, personal, scene
from vap_core import memory
from vap_core.attend import Attender
from vap_core.base.errors import BadDataset, BadOutput
from vap_core.perception.embedded import networks
from vap_core.perception.protocols import Thresholds, keep_thresholds, thresholds_file
from vap_core.perception.stacks import STACKS
from vap_core.policies.lerobot.datasets import open_dataset
from vap_core.recording import read_summary
from vap_core.study import dataset
from vap_core.study.dataset import inspect_dataset, report_table

BLUE, GREEN = (0, 0, 255), (0, 255, 0)
CAMERAS = ("top", "wrist")
SHOWN = ("grounded", "tracked", "losses", "longest")
TOLD = "bring my mug"


class Elsewhere(SameColour):
    """A tracker of another class."""


def picture(t: int, camera: str, episode: int) -> np.ndarray:
    """My blue mug moves; in the second episode the wrist does not show it in the middle."""
    other = [(40, 10, GREEN)]
    if episode == 1 and camera == "wrist" and t in (2, 3):
        return scene(other)
    return scene([(2 + 2 * t, 30, BLUE), *other])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of two cameras, as images, which come back bit for bit."""
    folder = tmp_path_factory.mktemp("datasets") / "desk"
    h, w = scene([]).shape[:2]
    features = {
        f"observation.images.{camera}": {"dtype": "image", "shape": (h, w, 3), "names": ["height", "width", "channels"]}
        for camera in CAMERAS
    }  # fmt: skip
    features["observation.state"] = {"dtype": "float32", "shape": (2,), "names": ["a", "b"]}
    features["action"] = {"dtype": "float32", "shape": (1,), "names": ["a"]}
    features["next.done"] = {"dtype": "bool", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create(
        "me/desk", fps=5, features=features, root=folder, robot_type="toy", use_videos=False
    )
    for episode in range(2):
        for t in range(5):
            frame = {
                f"observation.images.{camera}": picture(t, camera, episode) for camera in CAMERAS
            }
            frame["observation.state"] = np.array([t, episode], np.float32)
            frame["action"] = np.array([t], np.float32)
            frame["next.done"] = np.array([t == 4])
            dataset.add_frame({**frame, "task": "bring the mug"})
        dataset.save_episode()
    dataset.finalize()
    return folder


@pytest.fixture
def bank(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setitem(STACKS, "toys", lambda: TOYS)
    memory.save(tmp_path / "memory", personal("mug", "mug", BLUE))
    return tmp_path / "memory"


def test_frames_come_as_they_were_recorded(recorded: Path) -> None:
    opened = open_dataset(recorded)
    assert (opened.episodes, opened.hz, tuple(opened.keys)) == (2, 5.0, CAMERAS)
    frames = list(opened.frames(1))
    assert [frame.number for frame in frames] == list(range(5)) == list(range(opened.length(1)))
    for t, frame in enumerate(frames):
        assert frame.task == "bring the mug"
        assert frame.at_s == t / 5
        for camera in CAMERAS:
            assert (frame.views[camera] == picture(t, camera, 1)).all()


def test_losses_are_told_and_every_episode_is_a_recording(
    recorded: Path, bank: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    reports = inspect_dataset(recorded, TOLD, bank, "toys", out)
    found = {(row["episode"], row["camera"]): tuple(row[name] for name in SHOWN) for row in reports}
    assert found == {
        (0, "top"): (True, 5, 0, 0),
        (0, "wrist"): (True, 5, 0, 0),
        (1, "top"): (True, 5, 0, 0),
        (1, "wrist"): (True, 3, 1, 2),
    }
    table = report_table(reports)
    assert "4 of 4 views find the object" in table
    assert "18 of 20 frames, with 1 losses" in table
    assert [line.split()[:2] for line in table.splitlines()[2:3]] == [["1", "wrist"]]
    assert len((out / "views.csv").read_text().splitlines()) == 5
    for episode in range(2):
        assert read_summary(out / f"episode_{episode:06d}.rrd")


def test_the_same_call_goes_on_and_another_question_is_refused(
    recorded: Path, bank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    whole = inspect_dataset(recorded, TOLD, bank, "toys", out)
    kept = (out / "episode_000000.rrd").stat().st_mtime_ns
    (out / "episode_000001.json").unlink()
    again = inspect_dataset(recorded, TOLD, bank, "toys", out)
    assert [str(report) for report in again] == [str(report) for report in whole]
    assert (out / "episode_000000.rrd").stat().st_mtime_ns == kept
    for told, remembered in (("pick my mug", BLUE), (TOLD, GREEN)):
        memory.save(bank, personal("mug", "mug", remembered), replace=True)
        with pytest.raises(BadOutput, match="holds another run.*choose another folder with --out"):
            inspect_dataset(recorded, told, bank, "toys", out)


def test_answers_of_another_threshold_owner_or_version_are_not_taken_for_these(
    recorded: Path, bank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What `measure calibration --keep` writes changes what is grounded, and so does whose an object is."""
    out = tmp_path / "out"

    def refuses(differs: str) -> None:
        with pytest.raises(BadOutput, match=rf"another run \(.*{differs}.*\); choose"):
            inspect_dataset(recorded, TOLD, bank, "toys", out, episodes=1)

    monkeypatch.setenv("VAP_WEIGHTS", str(tmp_path / "weights"))
    shipped = replace(TOYS, thresholds=Thresholds(0.5, 0.5))
    monkeypatch.setitem(STACKS, "toys", lambda: shipped)
    inspect_dataset(recorded, TOLD, bank, "toys", out, episodes=1)
    keep_thresholds(tmp_path / "weights", "toys", TOYS.encoder.name, Thresholds(0.5, 0.99))
    refuses("thresholds")
    thresholds_file(tmp_path / "weights", "toys").unlink()
    inspect_dataset(recorded, TOLD, bank, "toys", out, episodes=1)
    monkeypatch.setattr(dataset, "__version__", "later")
    refuses("version")


def test_answers_of_other_parts_or_weights_are_not_taken_for_these(
    recorded: Path, bank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stack's name and its encoder's are as they were."""
    ask = (recorded, TOLD, bank, "toys", tmp_path / "out")
    inspect_dataset(*ask, episodes=1)
    other = replace(TOYS, tracker=Elsewhere())
    with monkeypatch.context() as patch:
        patch.setitem(STACKS, "toys", lambda: other)
        with pytest.raises(BadOutput, match=r"another run \(.*parts.*\); choose another"):
            inspect_dataset(*ask, episodes=1)
    monkeypatch.setattr(networks, "weights_sha256", lambda: {"tracker.npz": "0" * 64})
    with pytest.raises(BadOutput, match=r"another run \(.*weights.*\); choose another"):
        inspect_dataset(*ask, episodes=1)


@pytest.mark.parametrize("part", ["meta/info.json", "meta/episodes", "data"])
def test_answers_of_a_dataset_that_was_replaced_are_not_taken_for_these(
    recorded: Path, bank: Path, tmp_path: Path, part: str
) -> None:
    dataset, out = tmp_path / "desk", tmp_path / "out"
    shutil.copytree(recorded, dataset)
    inspect_dataset(dataset, TOLD, bank, "toys", out, episodes=1)
    inspect_dataset(dataset, TOLD, bank, "toys", out, episodes=1)
    path = dataset / part
    if path.is_file():
        path.write_text(path.read_text().replace('"toy"', '"arm"'))
    else:
        (path,) = path.rglob("*.parquet")
        pq.write_table(pq.read_table(path), path, compression="gzip")
    with pytest.raises(BadOutput, match=r"another run \(.*dataset.*\); choose another"):
        inspect_dataset(dataset, TOLD, bank, "toys", out, episodes=1)


def test_a_disk_that_is_full_at_the_table_is_one_line(
    recorded: Path, bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    inspect_dataset(recorded, TOLD, bank, "toys", out, episodes=1)
    (out / "views.csv").unlink()
    message = r"^inspect-dataset: .* cannot be written \(File too large\); make room"
    with pytest.raises(BadOutput, match=message), full_disk():
        inspect_dataset(recorded, TOLD, bank, "toys", out, episodes=1)


@pytest.mark.parametrize("whose", [{"owner": "ben"}, {"known_as": ("brother",)}])
def test_an_inspection_is_of_the_owners_that_it_knew(
    recorded: Path, bank: Path, tmp_path: Path, whose: dict[str, Any]
) -> None:
    known = {"owner": "anna", "known_as": ("sister",)}
    mug = personal("mug", "mug", BLUE)
    memory.save(bank, replace(mug, **known), replace=True)
    ask = (recorded, "bring anna's mug", bank, "toys", tmp_path / "out")
    inspect_dataset(*ask, episodes=1)
    memory.save(bank, replace(mug, **(known | whose)), replace=True)
    with pytest.raises(BadOutput, match=r"another run \(.*memory.*\); choose another"):
        inspect_dataset(*ask, episodes=1)


def test_a_damaged_record_of_an_inspection_is_one_line(
    recorded: Path, bank: Path, tmp_path: Path
) -> None:
    (tmp_path / "inspection.json").write_text("3")
    with pytest.raises(BadOutput, match=r"holds no run; choose another folder with --out"):
        inspect_dataset(recorded, TOLD, bank, "toys", tmp_path, episodes=1)


def test_a_copy_has_what_the_method_would_show_and_all_else_as_it_was(
    recorded: Path, bank: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    inspect_dataset(recorded, TOLD, bank, "toys", tmp_path / "out", copy=copy, masks=True)
    before, after = open_dataset(recorded), open_dataset(copy)
    attender = Attender(TOYS, memory.load_bank(bank))
    for episode in range(2):
        state = None
        for old, new in zip(before.frames(episode), after.frames(episode), strict=True):
            if state is None:
                state, attended = attender.start(old.views, TOLD)
            else:
                state, attended = attender.step(state, old.views)
            assert new.task == attended.text == "bring the red mug"
            for camera in CAMERAS:
                assert (new.views[camera] == attended.images[camera]).all()
                mask = attended.tracks[camera][0].mask
                stored = new.item[f"vap.mask.{camera}"].numpy().astype(bool)
                assert (stored == (np.zeros_like(stored) if mask is None else mask)).all()
            for key in ("observation.state", "action", "next.done", "timestamp", "episode_index"):
                assert (old.item[key] == new.item[key]).all(), key
    assert after.dataset.meta.robot_type == "toy"
    with pytest.raises(BadDataset, match="copy exists; choose another folder with --copy"):
        inspect_dataset(recorded, TOLD, bank, "toys", tmp_path / "out", copy=copy)


def test_a_dataset_of_two_tasks_is_inspected_but_not_copied(bank: Path, tmp_path: Path) -> None:
    """The task of the first would be written over the second's."""
    h, w = scene([]).shape[:2]
    feature = {"dtype": "image", "shape": (h, w, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        "me/two", fps=5, features={"observation.images.top": feature}, root=tmp_path / "two", use_videos=False
    )  # fmt: skip
    for task in ("bring the mug", "open the drawer"):
        dataset.add_frame({"observation.images.top": picture(0, "top", 0), "task": task})
        dataset.save_episode()
    dataset.finalize()
    out, copy = tmp_path / "out", tmp_path / "copy"
    with pytest.raises(BadDataset, match=r"2 tasks \('bring the mug', 'open the drawer'\).*split"):
        inspect_dataset(tmp_path / "two", TOLD, bank, "toys", out, copy=copy)
    assert not out.exists()
    assert not copy.exists()
    assert len(inspect_dataset(tmp_path / "two", TOLD, bank, "toys", out)) == 2
    inspect_dataset(tmp_path / "two", TOLD, bank, "toys", out, episodes=1, copy=copy)
    assert open_dataset(copy).episodes == 1


def test_a_copy_that_was_interrupted_is_not_there(
    recorded: Path, bank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vap_core.policies.lerobot.datasets.Copy.end_episode", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        inspect_dataset(recorded, TOLD, bank, "toys", tmp_path / "out", copy=tmp_path / "copy")
    assert not list(tmp_path.glob("*copy*"))
    assert not list(tmp_path.glob(".*copy*"))


@pytest.mark.parametrize("flaw", ["absent", "no info", "damaged", "no data", "version"])
def test_what_is_no_dataset_is_one_line(recorded: Path, tmp_path: Path, flaw: str) -> None:
    folder = tmp_path / "broken"
    shutil.copytree(recorded, folder)
    info = folder / "meta" / "info.json"
    match flaw:
        case "absent":
            shutil.rmtree(folder)
        case "no info":
            info.unlink()
        case "damaged":
            info.write_text("{")
        case "no data":
            shutil.rmtree(folder / "data")
        case "version":
            about = json.loads(info.read_text())
            info.write_text(json.dumps({**about, "codebase_version": "v2.1"}))
    with pytest.raises(BadDataset) as refusal:
        open_dataset(folder)
    assert "\n" not in str(refusal.value)
    assert str(folder) in str(refusal.value)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An episode of one camera as a video."""
    folder = tmp_path_factory.mktemp("datasets") / "filmed"
    shape = scene([]).shape
    feature = {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    features = {"observation.images.top": feature}
    dataset = LeRobotDataset.create("me/filmed", fps=5, features=features, root=folder)
    for t in range(3):
        dataset.add_frame({"observation.images.top": picture(t, "top", 0), "task": "bring it"})
    dataset.save_episode()
    dataset.finalize()
    assert len(list(open_dataset(folder).frames(0))) == 3
    return folder


def elsewhere(folder: Path) -> None:
    info = folder / "meta" / "info.json"
    about = json.loads(info.read_text())
    beside = "../out/{video_key}-{chunk_index}-{file_index}.mp4"
    info.write_text(json.dumps({**about, "video_path": beside}))
    (folder.parent / "out").mkdir()
    found = next((folder / "videos").rglob("*.mp4"))
    found.rename(folder.parent / "out" / "observation.images.top-0-0.mp4")


def instead(made: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = next((folder / "videos").rglob("*.mp4"))
        path.unlink()
        made(path)

    return change


@pytest.mark.timeout(120)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (instead(lambda path: film(path, 4096, "libx264", preset="ultrafast")), "4096x4096 pixels"),
        (instead(lambda path: path.write_text(LISTS["ffconcat"]("pipe"))), "cannot be decoded"),
        (instead(lambda path: path.write_text(LISTS["m3u8"]("pipe"))), "cannot be decoded"),
        (instead(os.mkfifo), "is not a file"),
        (instead(lambda path: path.symlink_to("/dev/zero")), "is not a file"),
        (instead(lambda path: path.write_bytes(b"")), "cannot be decoded"),
        (elsewhere, "lies outside of the dataset"),
    ],
)
def test_a_video_of_a_dataset_has_the_limit_of_clips(
    filmed: Path, tmp_path: Path, change: Callable[[Path], None], words: str
) -> None:
    folder = shutil.copytree(filmed, tmp_path / "copy")
    os.mkfifo(tmp_path / "pipe")
    change(folder)
    with pytest.raises(BadDataset, match=words) as refusal:
        list(open_dataset(folder).frames(0))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("data", "path", "words"),
    [
        (claims(8000), None, "pixels, over 50 million"),
        (EPS, None, "cannot be read as an image, it is none of"),
        (b"", None, "cannot be read as an image"),
        (None, "/etc/hostname", "lies outside of the dataset"),
        (None, "hf://datasets/a/b/c.png", "cannot be read"),
        (None, "../x.png", "lies outside of the dataset"),
    ],
)
def test_a_picture_of_a_dataset_has_the_limit_of_photos(
    recorded: Path, tmp_path: Path, data: bytes | None, path: str | None, words: str
) -> None:
    folder = shutil.copytree(recorded, tmp_path / "copy")
    (file,) = (folder / "data").rglob("*.parquet")
    table = pq.read_table(file)
    name = "observation.images.top"
    cells = [{"bytes": data, "path": path}] * len(table)
    column = pa.array(cells, table[name].type)
    pq.write_table(table.set_column(table.column_names.index(name), name, column), file)
    with pytest.raises(BadDataset, match=words) as refusal:
        list(open_dataset(folder).frames(0))
    assert "\n" not in str(refusal.value)


def test_two_features_of_one_camera_are_refused(tmp_path: Path) -> None:
    """The second took the first's place, and the first was copied without a prompt."""
    h, w = scene([]).shape[:2]
    feature = {"dtype": "image", "shape": (h, w, 3), "names": ["height", "width", "channels"]}
    keys = ("observation.images.front", "observation.front")
    dataset = LeRobotDataset.create(
        "me/twice", fps=5, features=dict.fromkeys(keys, feature), root=tmp_path / "twice", use_videos=False
    )  # fmt: skip
    dataset.add_frame(dict.fromkeys(keys, picture(0, "top", 0)) | {"task": "bring the mug"})
    dataset.save_episode()
    dataset.finalize()
    said = r"twice has pictures .*images\.front and observation\.front, .*'front' here; remove one"
    with pytest.raises(BadDataset, match=said):
        open_dataset(tmp_path / "twice")


def test_the_command(recorded: Path, bank: Path, tmp_path: Path) -> None:
    words = ("inspect-dataset", recorded, TOLD, "--memory", bank, "--stack", "toys")
    done = vap(*words, "--episodes", 1, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "2 of 2 views find the object in their first frame" in done.stdout
    assert "1 recordings" in done.stdout
    said = refused("inspect-dataset", tmp_path / "none", TOLD, "--memory", bank, "--stack", "toys")
    assert "is no LeRobotDataset" in said
