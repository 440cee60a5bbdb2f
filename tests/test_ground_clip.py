"""ground on clips: tracks through, and what is written."""

import errno
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from tests.command import refused, vap
from tests.toys import MeanColour, SameColour, detector, scene, segmenter
from vap_core.attend import Attender
from vap_core.base import media
from vap_core.base.errors import BadOutput
from vap_core.base.types import Boxes
from vap_core.memory import remember, save
from vap_core.perception import stacks
from vap_core.perception.protocols import Stack
from vap_core.recording import show as film_pictures
from vap_core.recording import write_film
from vap_core.study import grounding
from vap_core.study.grounding import claimed_paths

RED, GREEN = (250, 0, 0), (0, 250, 0)


@pytest.fixture
def bank(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    stack = Stack("toy", detector, MeanColour(), segmenter, SameColour())
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: stack)
    mug = remember("mug", "cup", [scene([(26, 26, RED)])], MeanColour())
    save(tmp_path / "bank", mug)
    return tmp_path / "bank"


def frames(folder: Path, squares) -> Path:
    folder.mkdir()
    for i, of_frame in enumerate(squares):
        Image.fromarray(scene(of_frame)).save(folder / f"{i:03}.png")
    return folder


def test_stretches_without_the_object_that_are_not_named_are_counted():
    def said(n: int) -> str:
        lost = tuple((2 * i, 2 * i) for i in range(1, n + 1))
        summary = grounding.ClipSummary(
            frames=40, grounded=0, tracked=40 - n, lost=lost, text="bring it", object="mug"
        )
        return str(summary).splitlines()[1]

    six = "not visible in frames 2-2, 4-4, 6-6, 8-8, 10-10, 12-12"
    assert [said(6), said(7), said(10)] == [six, f"{six} and 1 more", f"{six} and 4 more"]


def test_a_folder_of_frames_is_tracked_through(bank, tmp_path):
    """Found in frame 5, the second try; gone in frame 7."""
    squares = [[]] * 5 + [
        [(4, 4, GREEN), (40, 10, RED)],
        [(8, 4, GREEN), (42, 12, RED)],
        [],
        [(44, 14, RED)],
    ]
    clip = frames(tmp_path / "clip", squares)
    done = vap(
        "ground", clip, "bring my cup", "--stack", "toy", "--memory", bank, "--out", tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "grounded in frame 5 of 9; tracked in 3 frames" in done.stdout
    assert "not visible in frames 7-7" in done.stdout
    assert "instruction: bring the " in done.stdout
    film = list(media.frames(tmp_path / "clip.mp4"))
    assert len(film) == 9
    assert media.frame_rate(tmp_path / "clip.mp4") == grounding.FOLDER_HZ
    changed = np.abs(film[5].astype(int) - scene(squares[5])).mean(axis=2) > 60
    assert changed[10:22, 40:52].mean() > 0.5
    assert changed[4:16, 4:16].mean() < 0.2
    assert (tmp_path / "clip.rrd").stat().st_size > 5000
    again = vap(
        "ground",
        tmp_path / "clip.mp4",
        "bring my cup",
        "--stack",
        "toy",
        "--memory",
        bank,
        "--out",
        tmp_path,
    )
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "clip-2.rrd").exists()


def test_a_clip_without_the_object_says_so(bank, tmp_path):
    clip = frames(tmp_path / "clip", [[]] * 3)
    done = vap(
        "ground", clip, "bring my cup", "--stack", "toy", "--memory", bank, "--out", tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "not in view in any of 3 frames" in done.stdout
    assert len(list(media.frames(tmp_path / "clip.mp4"))) == 3


def test_while_the_first_target_is_not_in_view_no_other_is_tinted(bank, tmp_path, monkeypatch):
    def bowls(images, phrase, threshold=None):
        found = detector(images, phrase)
        nothing = Boxes(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), phrase)
        return found if phrase == "bowl" else [nothing] * len(images)

    stack = Stack("toy", bowls, MeanColour(), segmenter, SameColour())
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: stack)
    save(bank, remember("dish", "bowl", [scene([(26, 26, GREEN)])], MeanColour()))
    clip = frames(tmp_path / "clip", [[(26, 26, GREEN)]] * 2)
    words = ("ground", clip, "put my cup near my bowl", "--stack", "toy", "--memory", bank)
    done = vap(*words, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    for shown in media.frames(tmp_path / "clip.mp4"):
        changed = np.abs(shown.astype(int) - scene([(26, 26, GREEN)])).mean(axis=2) > 60
        assert changed.mean() < 0.02


@pytest.mark.parametrize("form", [(), ("--json",), ("clip",)])
def test_two_objects_in_one_box_are_said(bank, tmp_path, monkeypatch, form):
    """The second keeps its words, and is not noted as used; another command says no such thing."""
    save(bank, remember("dish", "bowl", [scene([(26, 26, RED)])], MeanColour()))
    seen = frames(tmp_path / "clip", [[(4, 4, GREEN), (40, 10, RED)]])
    if "clip" not in form:
        seen = seen / "000.png"
    options = [word for word in form if word != "clip"]
    where = ("--stack", "toy", "--memory", bank, "--out", tmp_path / "out", *options)
    done = vap("ground", seen, "put my cup near my bowl", *where)
    assert done.returncode == 0, done.stderr
    assert "put the blue cup near my bowl" in done.stdout
    assert done.stderr.count("two targets share one object, at most one is right") == 1
    used = (bank / "history.jsonl").read_text()
    assert ("mug" in used, "dish" in used) == (True, False)
    done = vap("ground", seen, "put my bowl near a plate, then my bowl in a bin", *where)
    assert "put the blue bowl near a plate, then the blue bowl in a bin" in done.stdout
    assert "share" not in done.stderr
    assert (bank / "history.jsonl").read_text().count("dish") == 1


def test_always_tint_reaches_a_clip(bank, tmp_path, monkeypatch):
    asked = []

    class Asked(Attender):
        def __init__(self, stack, memory, prompting=None, **how) -> None:
            asked.append(prompting.always_tint)
            super().__init__(stack, memory, prompting, **how)

    monkeypatch.setattr(grounding, "Attender", Asked)
    clip = frames(tmp_path / "clip", [[(26, 26, RED)]] * 2)
    where = ("--stack", "toy", "--memory", bank, "--out", tmp_path / "out")
    for option in ((), ("--always-tint",)):
        assert vap("ground", clip, "bring my cup", *where, *option).returncode == 0
    assert asked == [False, True]


def test_two_at_once_write_two_films_and_two_recordings(tmp_path):
    with claimed_paths(tmp_path, "desk", ".mp4") as first:
        with claimed_paths(tmp_path, "desk", ".mp4") as second:
            pass
        assert [path.name for path in first] == ["desk.mp4", "desk.rrd"]
        assert [path.name for path in second] == ["desk-2.mp4", "desk-2.rrd"]
    with pytest.raises(ValueError, match="fails"), claimed_paths(tmp_path, "desk", ".mp4") as third:
        raise ValueError("fails")
    assert third == first
    assert not list(tmp_path.iterdir())


def test_bad_clips_are_one_line(bank, tmp_path):
    line = refused("ground", tmp_path, "bring my cup", "--memory", bank, "--json")
    assert "--json are for single pictures" in line
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.mp4").write_bytes(b"x")
    for name, message in (
        ("empty", "holds no picture"),
        ("bad.mp4", "cannot be decoded"),
        ("gone.mp4", "is not a file"),
    ):
        line = refused(
            "ground", tmp_path / name, "bring my cup", "--stack", "toy", "--memory", bank
        )
        assert message in line


def test_frames_of_two_sizes_are_one_line(bank, tmp_path):
    clip = frames(tmp_path / "clip", [[(26, 26, RED)]] * 2)
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(clip / "002.png")
    line = refused("ground", clip, "bring my cup", "--stack", "toy", "--memory", bank)
    assert "002.png has another shape than the first frame (64x48 and 64x64 pixels" in line


def test_a_film_of_a_clip_keeps_its_shape_and_its_pace(bank, tmp_path):
    clip = tmp_path / "wide.mp4"
    with media.Mp4(clip, hz=20.0) as file:
        for x in range(20, 60, 2):
            file.add(np.hstack([scene([(x, 26, RED)], size=96)] * 2))
    done = vap(
        "ground", clip, "bring my cup", "--stack", "toy", "--memory", bank, "--out", tmp_path / "o"
    )
    assert done.returncode == 0, done.stderr
    write_film(tmp_path / "o" / "wide.rrd", tmp_path / "film.mp4")
    film = list(media.frames(tmp_path / "film.mp4"))
    assert round(media.frame_rate(tmp_path / "film.mp4")) == 20
    assert film[0].shape == (film_pictures.SIDE_PX + 2 * film_pictures.BAR_PX, 960, 3)
    assert len(film) == 20 + 30 + 50, "the last frame is the deciding one, and stands still"


def test_a_film_on_a_full_disk_is_one_line(tmp_path):
    """Packets reach the disk with a later picture, or when the file is closed."""

    def full(packets: object) -> None:
        if list(packets):
            raise OSError(errno.ENOSPC, "No space left on device")

    def write(pictures: int) -> int:
        with media.Mp4(tmp_path / "film.mp4", hz=10.0) as file:
            whole = file._container
            file._container = SimpleNamespace(
                add_stream=whole.add_stream, mux=full, close=whole.close
            )
            for i in range(pictures):
                try:
                    file.add(scene([]))
                except BadOutput:
                    written.append(i)
                    raise
        return pictures

    written: list[int] = []
    for pictures in (1, 200):
        with pytest.raises(BadOutput, match="No space left on device.*make room"):
            write(pictures)
    assert len(written) == 1, "one failed when it was closed, the other at a picture"
    assert not list(tmp_path.iterdir())
    with pytest.raises(BadOutput, match="cannot be written"), media.Mp4(Path("/proc/f.mp4"), 10.0):
        pass


def test_boxes_are_of_the_picture_as_it_is_shrunk(bank, tmp_path, monkeypatch):
    monkeypatch.setattr(grounding, "GROUND_SIDE", 256)
    rgb = np.zeros((180, 400, 3), np.uint8)
    rgb[90:130, 200:240] = RED
    Image.fromarray(rgb).save(tmp_path / "long.png")
    words = ("ground", tmp_path / "long.png", "bring my cup", "--stack", "toy", "--memory", bank)
    done = vap(*words, "--out", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    assert "boxes are pixels of the picture at 256x115" in done.stderr
    assert json.loads(done.stdout)["size"] == [256, 115]


def test_boxes_by_hand_are_judged_by_the_detector_itself(bank, tmp_path, monkeypatch):
    asked = []

    class Judge:
        def __call__(self, images, phrase, threshold):
            return detector(images, phrase, threshold)

        def is_familiar(self, rgb, phrase) -> bool:
            asked.append(phrase)
            return True

    stack = Stack("toy", Judge(), MeanColour(), segmenter, SameColour())
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: stack)
    Image.fromarray(scene([(26, 26, RED)])).save(tmp_path / "desk.png")
    words = ("ground", tmp_path / "desk.png", "bring my cup", "--stack", "toy", "--memory", bank)
    done = vap(*words, "--out", tmp_path, "--box", "26,26,38,38")
    assert done.returncode == 0, done.stderr
    assert asked == ["cup"]
