"""Ended before any of its renames, a command leaves whole files alone, and the same command then ends as if nothing had happened.

Runs of episodes are killed in test_engine, trainings end in test_policy_training.
"""

from pathlib import Path

import pytest
from PIL import Image

from tests.deaths import die_before_each_rename
from tests.test_report import run
from tests.toys import MeanColour, SameColour, detector, scene, segmenter
from vap_core.analysis.ground_clip import ground_clip
from vap_core.base import video
from vap_core.evaluation.report import report
from vap_core.memory import remember, save
from vap_core.perception import stacks
from vap_core.perception.protocols import Stack
from vap_core.recording import read_summary


def named(folder: Path) -> dict[str, bytes]:
    """The files that have their names; hidden ones are scratch."""
    return {
        file.name: file.read_bytes() for file in folder.iterdir() if not file.name.startswith(".")
    }


def test_a_report_that_is_ended_keeps_or_replaces_each_file_of_an_earlier_one(
    tmp_path: Path,
) -> None:
    one, other = run(tmp_path / "one"), run(tmp_path / "other", episodes=4)
    torn, whole = tmp_path / "torn", tmp_path / "whole"
    report([other], torn)
    before = named(torn)
    report([one], whole)
    after = named(whole)
    assert before != after

    def each_is_of_one_report() -> None:
        for name, content in named(torn).items():
            assert content in (before.get(name), after.get(name)), f"{name} is torn"

    ends = die_before_each_rename(lambda: report([one], torn), each_is_of_one_report)
    assert ends == len(after)
    assert {name: named(torn)[name] for name in after} == after


RED = (250, 0, 0)


def test_a_clip_that_is_ended_leaves_no_half_film(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = Stack("toy", detector, MeanColour(), segmenter, SameColour())
    monkeypatch.setitem(stacks.STACKS, "toy", lambda: stack)
    bank, clip, torn = tmp_path / "bank", tmp_path / "clip", tmp_path / "torn"
    save(bank, remember("mug", "cup", [scene([(26, 26, RED)])], MeanColour()))
    clip.mkdir()
    for i in range(12):
        Image.fromarray(scene([(20 + i, 20, RED)])).save(clip / f"{i:03}.png")
    torn.mkdir()

    def all_are_whole() -> None:
        for film in torn.glob("[!.]*.mp4"):
            assert len(list(video.frames(film))) == 12
        for recording in torn.glob("[!.]*.rrd"):
            read_summary(recording)

    assert die_before_each_rename(
        lambda: ground_clip(clip, "bring my cup", bank, "toy", torn), all_are_whole
    )
    all_are_whole()
    assert list(torn.glob("clip*.mp4"))
