"""A recording's pictures, raw and prompted, of every camera: one JPEG each, or one AV1 stream a view, far smaller for several times the work."""

import os
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, Protocol

import numpy as np
import rerun as rr

from vap_core.record.evidence import jpeg, send_jpegs
from vap_core.record.file import put
from vap_core.values import Frame, Rgb

PROMPTED_QUALITY_DROP = 5
"""Prompted pictures repeat the raw ones outside the mask: they may be a little coarser."""
PRESET, CRF, KEY_EVERY = 10, 32, 60
"""Of SVT-AV1: presets from 0, best, to 13, fastest; constant rate factors from 0, lossless, to 63; and how far back a viewer has to go, pictures."""
type When = tuple[int, float]
"""Step and second."""


def time_index(when: Sequence[When]) -> list[rr.TimeColumn]:
    """The two time lines of a recording."""
    steps, seconds = [step for step, _ in when], np.array([second for _, second in when], np.float64)
    return [rr.TimeColumn("frame_index", sequence=steps), rr.TimeColumn("timestamp", duration=seconds)]


class Pictures(Protocol):
    """Takes pictures as they come and sends what is ready; `last` with the end of the episode."""

    def take(self, frame: Frame) -> None: ...

    def send(self, rec: rr.RecordingStream, *, last: bool = False) -> None: ...


def entities(frame: Frame) -> dict[str, tuple[Rgb, Rgb]]:
    """Per camera's entity what was seen, and what the policy was shown: the same array where nothing was changed."""
    pairs = {f"/observation.images.{cam}": (raw, frame.prompted.get(cam, raw)) for cam, raw in frame.images.items()}
    return {root: (raw, raw if shown is raw or np.array_equal(raw, shown) else shown) for root, (raw, shown) in pairs.items()}


class Stills:
    """JPEGs, compressed at once."""

    def __init__(self, quality: int = 90) -> None:
        self._quality = quality
        self._held: list[tuple[When, Mapping[str, np.ndarray]]] = []

    def take(self, frame: Frame) -> None:
        pictures = {}
        for root, (raw, shown) in entities(frame).items():
            pictures[root] = seen = jpeg(raw, self._quality)
            pictures[f"{root}/prompted"] = seen if shown is raw else jpeg(shown, self._quality - PROMPTED_QUALITY_DROP)
        if pictures:
            self._held.append(((frame.frame_index, frame.timestamp_s), pictures))

    def send(self, rec: rr.RecordingStream, *, last: bool = False) -> None:
        if not self._held:
            return
        index = time_index([when for when, _ in self._held])
        for entity in self._held[0][1]:
            send_jpegs(rec, entity, index, [pictures[entity] for _, pictures in self._held])
        self._held = []


class Reels:
    """AV1 streams. A packet may come out later than its picture went in."""

    def __init__(self, hz: float) -> None:
        self._hz = hz
        self._reels: dict[str, Reel] = {}

    def take(self, frame: Frame) -> None:
        for root, pair in entities(frame).items():
            for entity, rgb in zip((root, f"{root}/prompted"), pair, strict=True):
                if entity not in self._reels:
                    self._reels[entity] = Reel(rgb, self._hz)
                self._reels[entity].add(rgb, (frame.frame_index, frame.timestamp_s))

    def send(self, rec: rr.RecordingStream, *, last: bool = False) -> None:
        for entity, reel in self._reels.items():
            if not reel.begun:
                put(rec, entity, rr.VideoStream(codec=rr.VideoCodec.AV1))
                reel.begun = True
            packets = reel.ready(last)
            if packets:
                samples, keys = [data for _, data, _ in packets], [key for _, _, key in packets]
                rec.send_columns(entity, time_index([when for when, _, _ in packets]), rr.VideoStream.columns(sample=samples, is_keyframe=keys))


class Reel:
    """One view's encoder."""

    def __init__(self, rgb: Rgb, hz: float) -> None:
        os.environ.setdefault("SVT_LOG", "1")  # errors alone
        import av

        height, width = rgb.shape[:2]
        coder: Any = av.CodecContext.create("libsvtav1", "w")
        coder.width, coder.height, coder.pix_fmt, coder.time_base = width, height, "yuv420p", Fraction(1, max(1, round(hz)))
        coder.options = {"preset": str(PRESET), "crf": str(CRF), "svtav1-params": f"pred-struct=1:keyint={KEY_EVERY}:lp=1"}
        self.begun = False
        self._coder = coder
        self._when: list[When] = []
        self._packets: list[Any] = []

    def add(self, rgb: Rgb, when: When) -> None:
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        frame.pts = len(self._when)
        self._when.append(when)
        self._packets += self._coder.encode(frame)

    def ready(self, last: bool) -> list[tuple[When, bytes, bool]]:
        """Packets since the last call: when their picture was taken, their bytes, and whether they stand alone."""
        self._packets += self._coder.encode(None) if last else []
        packets, self._packets = self._packets, []
        return [(self._when[int(packet.pts or 0)], bytes(packet), packet.is_keyframe) for packet in packets]
