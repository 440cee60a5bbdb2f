"""The failures of a report: the right recording, and one that is damaged."""

from pathlib import Path

import pytest

from tests.drawn import opening, record
from vap_core.base.errors import BadRecording
from vap_core.recording import recording_file_name
from vap_core.study import report


def test_a_failure_is_pictured_by_the_recording_of_its_own_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs of one suite and method, with different policies, name their files alike."""
    name = recording_file_name("simpler-bridge", "put-camera", 3, 0, "vap")
    sources = [tmp_path / run for run in ("a", "b", "damaged")]
    for source in sources:
        (source / "recordings").mkdir(parents=True)
        (source / "recordings" / name).write_bytes(b"")

    row = {
        "suite": "simpler-bridge",
        "task": "put-camera",
        "episode": 3,
        "seed": 0,
        "method": "vap",
    }
    whole = {**row, "outcome": "failure", "steps": 60}
    said = whole

    def summary(path: Path) -> dict[str, object]:
        if "damaged" in path.parts:
            raise BadRecording("damaged")
        return {**said, "policy": path.parts[-3]}

    monkeypatch.setattr("vap_core.recording.read_summary", summary)
    of_b = {**row, "policy": "b"}
    path = sources[1] / "recordings" / name
    assert report._recorded(of_b, sources) == path
    assert report._recorded({**row, "policy": "c"}, sources) is None
    for other in ({**whole, "episode": 4}, {**whole, "method": "generic"}, row):
        said = other
        assert report._recorded(of_b, sources) is None


def test_a_card_gives_a_command_for_a_shell(tmp_path: Path) -> None:
    row = dict.fromkeys(("suite", "task", "method", "case", "sub_case", "case_sentence"), "a")
    row |= {"episode": 1, "seed": 0, "deciding_frame": 2}
    card = report._card(row, tmp_path / "a b.rrd", [tmp_path], tmp_path)
    assert f"view &#x27;{tmp_path}/a b.rrd&#x27; --frame 2" in card
    without = report._card(row, None, [tmp_path], tmp_path)
    assert f"diagnose {tmp_path} --suite a --task a --method a --where" in without
    assert without.startswith("<article data-case='a' data-task='a'>"), "what the page filters by"


def test_a_recording_with_damaged_pictures_is_a_remark(tmp_path: Path) -> None:
    """`report` ended with the decoder's error."""
    path = tmp_path / "a.rrd"
    record(path, opening(), steps=4)
    row = dict.fromkeys(("suite", "task", "method", "case", "sub_case", "case_sentence"), "a")
    row |= {"episode": 1, "deciding_frame": 2}
    assert "<img" in report._card(row, path, [], tmp_path)
    whole = path.read_bytes()
    for damaged in (
        whole[: len(whole) // 2],
        whole.replace(b"\xff\xd8\xff", b"\x00\x00\x00"),
        whole[: len(whole) // 3] + bytes(200) + whole[len(whole) // 3 + 200 :],
    ):
        path.write_bytes(damaged)
        card = report._card(row, path, [], tmp_path)
        assert "<article" in card
        assert "<img" in card or "its pictures cannot be read (" in card
