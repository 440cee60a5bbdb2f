"""A recording's pictures, raw and prompted, of every camera.

Either one JPEG each, or one AV1 stream per view: far smaller for several times the work.
"""

import os
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

import numpy as np
import rerun as rr

from vap_core.base.types import Rgb
from vap_core.recording.entities.images import encode_jpeg, send_jpegs
from vap_core.recording.entities.paths import image_root
from vap_core.recording.stream import Moment, log_row, time_columns
from vap_core.rollout.types import Frame

JPEG_QUALITY = 90
PROMPTED_JPEG_QUALITY = 85
"""Prompted pictures repeat the raw ones outside the mask: they may be a little coarser."""
SVT_AV1_PRESET = 10
"""From 0, best, to 13, fastest."""
SVT_AV1_CRF = 32
"""Constant rate factor from 0, lossless, to 63."""
KEYFRAME_INTERVAL = 60
"""How far back a viewer has to decode, pictures."""


class Pictures(Protocol):
    """Takes the pictures of frames as they come and sends what is ready."""

    def add(self, frame: Frame) -> None: ...

    def send(self, rec: rr.RecordingStream, *, last: bool = False) -> None:
        """`last` at the end of the episode."""
        ...


class StillPictures:
    """JPEGs, compressed at once."""

    def __init__(self) -> None:
        self._unsent: list[tuple[Moment, Mapping[str, np.ndarray]]] = []

    def add(self, frame: Frame) -> None:
        jpegs = {}
        for root, (raw, prompted) in picture_pairs(frame).items():
            jpegs[root] = encode_jpeg(raw, JPEG_QUALITY)
            jpegs[f"{root}/prompted"] = jpegs[root]
            if prompted is not raw:
                jpegs[f"{root}/prompted"] = encode_jpeg(prompted, PROMPTED_JPEG_QUALITY)
        if jpegs:
            self._unsent.append(((frame.frame_index, frame.timestamp_s), jpegs))

    def send(self, rec: rr.RecordingStream, *, last: bool = False) -> None:
        if not self._unsent:
            return
        index = time_columns([moment for moment, _ in self._unsent])
        for entity in self._unsent[0][1]:
            send_jpegs(rec, entity, index, [jpegs[entity] for _, jpegs in self._unsent])
        self._unsent = []


class VideoPictures:
    """AV1 streams. A packet may be ready some pictures after its own was added."""

    def __init__(self, hz: float) -> None:
        self._hz = hz
        self._encoders: dict[str, VideoEncoder] = {}

    def add(self, frame: Frame) -> None:
        moment = (frame.frame_index, frame.timestamp_s)
        for root, (raw, prompted) in picture_pairs(frame).items():
            self._encode(root, raw, moment)
            self._encode(f"{root}/prompted", prompted, moment)

    def send(self, rec: rr.RecordingStream, *, last: bool = False) -> None:
        for entity, encoder in self._encoders.items():
            if not encoder.is_declared:
                log_row(rec, entity, rr.VideoStream(codec=rr.VideoCodec.AV1))
                encoder.is_declared = True
            packets = encoder.take_packets(last)
            if packets:
                _send_packets(rec, entity, packets)

    def _encode(self, entity: str, rgb: Rgb, moment: Moment) -> None:
        if entity not in self._encoders:
            self._encoders[entity] = VideoEncoder(rgb, self._hz)
        self._encoders[entity].add(rgb, moment)


class Packet(NamedTuple):
    """An encoded picture: when it was taken, its bytes, and whether it decodes by itself."""

    moment: Moment
    sample: bytes
    is_keyframe: bool


class VideoEncoder:
    """The encoder of one view."""

    def __init__(self, rgb: Rgb, hz: float) -> None:
        os.environ.setdefault("SVT_LOG", "1")  # errors alone
        import av

        codec: Any = av.CodecContext.create("libsvtav1", "w")
        codec.height, codec.width = rgb.shape[:2]
        codec.pix_fmt = "yuv420p"
        codec.time_base = Fraction(1, max(1, round(hz)))
        codec.options = {
            "preset": str(SVT_AV1_PRESET),
            "crf": str(SVT_AV1_CRF),
            "svtav1-params": f"pred-struct=1:keyint={KEYFRAME_INTERVAL}:lp=1",
        }
        self.is_declared = False
        """Whether the recording has the stream's codec."""
        self._codec = codec
        self._moments: list[Moment] = []
        self._packets: list[Any] = []

    def add(self, rgb: Rgb, moment: Moment) -> None:
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        frame.pts = len(self._moments)
        self._moments.append(moment)
        self._packets += self._codec.encode(frame)

    def take_packets(self, last: bool) -> list[Packet]:
        """The packets since the previous call; `last` ends the stream."""
        if last:
            self._packets += self._codec.encode(None)
        packets = []
        for packet in self._packets:
            moment = self._moments[int(packet.pts or 0)]
            packets.append(Packet(moment, bytes(packet), packet.is_keyframe))
        self._packets = []
        return packets


def picture_pairs(frame: Frame) -> dict[str, tuple[Rgb, Rgb]]:
    """By camera entity the raw and the prompted picture: the same array where they are equal."""
    pairs = {}
    for camera, raw in frame.images.items():
        prompted = frame.prompted.get(camera, raw)
        if prompted is not raw and np.array_equal(raw, prompted):
            prompted = raw
        pairs[image_root(camera)] = (raw, prompted)
    return pairs


def _send_packets(rec: rr.RecordingStream, entity: str, packets: Sequence[Packet]) -> None:
    moments, samples, are_keyframes = zip(*packets, strict=True)
    columns = rr.VideoStream.columns(sample=samples, is_keyframe=are_keyframes)
    rec.send_columns(entity, time_columns(moments), columns)
