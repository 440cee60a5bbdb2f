"""Which episodes become recordings, and in what form their pictures are kept."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drawn import ROW, SUCCESS, columns, frame, opening, rerun
from vap_core.recording import Recorder, read_summary
from vap_core.recording import recorder as keep
from vap_core.recording.stream import temporary_path
from vap_core.simulation.types import Outcome
from vap_core.study.diagnosis import explain


def failed(outcome: Outcome) -> bool:
    return outcome.status == "failure"


@pytest.mark.parametrize("most_mb", [1e9, 0.1], ids=["in memory", "streamed"])
def test_only_what_is_wanted_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most_mb: float
) -> None:
    monkeypatch.setattr(keep, "MAX_BUFFER_MB", most_mb)
    start = opening(2)
    for status in ("success", "failure"):
        sink = keep.DeferredRecorder(tmp_path / f"{status}.rrd", start, failed)
        for step in range(8):
            sink.frame(frame(step, start))
        assert temporary_path(sink.path).exists() == (most_mb < 1)
        sink.close(replace(SUCCESS, status=status, success=status == "success", steps=7))
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["failure.rrd"]
    assert read_summary(tmp_path / "failure.rrd")["frames"] == 8


def test_what_waited_is_recorded_as_if_it_had_streamed(tmp_path: Path) -> None:
    start = opening(2)
    streamed = Recorder(
        tmp_path / "streamed.rrd", start, flush_every=keep.FLUSH_EVERY, explain=explain
    )
    waited = keep.DeferredRecorder(
        tmp_path / "waited.rrd", start, lambda outcome: True, explain=explain
    )
    for sink in (streamed, waited):
        for step in range(12):
            sink.frame(frame(step, start))
        sink.close(replace(SUCCESS, steps=12))
    same = rerun("rrd", "compare", tmp_path / "streamed.rrd", tmp_path / "waited.rrd")
    assert same.returncode == 0, same.stderr[-500:]


def test_one_success_in_ten_is_kept_and_always_the_same() -> None:
    rows = [replace(ROW, episode=i) for i in range(400)]
    chosen = [keep.is_failure_or_sampled(SUCCESS, row, "vap") for row in rows]
    assert chosen == [keep.is_failure_or_sampled(SUCCESS, row, "vap") for row in rows]
    assert 0.06 < sum(chosen) / 400 < 0.14
    assert all(
        keep.is_failure_or_sampled(replace(SUCCESS, status=status, success=False), row, "vap")
        for row in rows
        for status in ("failure", "error")
    )


def test_pictures_may_be_rarer_than_steps(tmp_path: Path) -> None:
    start = opening(1)
    with Recorder(tmp_path / "one.rrd", start, flush_every=5) as recorder:
        for step in range(12):
            one = frame(step, start)
            recorder.frame(one if step % 4 == 0 else replace(one.without_images(), tracks={}))
        recorder.close(SUCCESS)
    for entity in ("", "/prompted"):
        assert sorted(
            columns(tmp_path / "one.rrd", f"/observation.images.front{entity}", "EncodedImage:blob")
        ) == [0, 4, 8]
    assert len(columns(tmp_path / "one.rrd", "/action", "Scalars:scalars")) == 12
    assert sorted(columns(tmp_path / "one.rrd", "/vap/track_score/front", "Scalars:scalars")) == [
        0,
        4,
        8,
    ]


def test_as_video_every_picture_stands_at_its_step_and_weighs_less(tmp_path: Path) -> None:
    import av

    start = opening(1)
    for name, video in (("stills", False), ("video", True)):
        with Recorder(tmp_path / f"{name}.rrd", start, video=video) as recorder:
            for step in range(20):
                one = frame(step, start)
                recorder.frame(one if step % 2 == 0 else one.without_images())
            recorder.close(SUCCESS)
    assert rerun("rrd", "verify", tmp_path / "video.rrd").returncode == 0
    for entity, kind in (("", "images"), ("/prompted", "prompted")):
        samples = columns(
            tmp_path / "video.rrd", f"/observation.images.front{entity}", "VideoStream:sample"
        )
        assert sorted(samples) == list(range(0, 20, 2))
        decoder = av.CodecContext.create("libdav1d", "r")
        packets = [av.Packet(bytes(samples[step][0])) for step in sorted(samples)]  # type: ignore[index]
        shown = [
            seen.to_ndarray(format="rgb24")
            for packet in (*packets, None)
            for seen in decoder.decode(packet)
        ]
        assert len(shown) == 10
        for step, picture in zip(range(0, 20, 2), shown, strict=True):
            assert (
                np.abs(picture.astype(int) - getattr(frame(step, start), kind)["front"]).mean() < 6
            )
        blobs = columns(
            tmp_path / "stills.rrd", f"/observation.images.front{entity}", "EncodedImage:blob"
        )
        assert 2 * sum(len(one[0]) for one in samples.values()) < sum(
            len(one[0]) for one in blobs.values()
        )
