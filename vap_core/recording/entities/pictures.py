"""A recording's pictures, raw and prompted, of every camera.

Either one JPEG each, or one AV1 stream per view: far smaller for several times the work.
"""

import os
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
import rerun as rr

from vap_core.base.pictures import object_labels
from vap_core.base.types import Camera, Mask, Rgb
from vap_core.perception.boxes import mask_box
from vap_core.policies.protocol import heat_map
from vap_core.recording.colours import CAMERAS, ELECTED, GOAL, TARGET, image_root, target_suffix
from vap_core.recording.stream import Moment, frame_times, log_row, time_columns
from vap_core.rollout.types import EpisodeHeader, Frame


def encode_jpeg(rgb: Rgb, quality: int) -> np.ndarray:
    """JPEG bytes of an RGB picture."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]


def jpeg_image(jpeg: np.ndarray) -> rr.EncodedImage:
    """JPEG bytes as an archetype."""
    return rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")


def send_jpegs(
    rec: rr.RecordingStream,
    entity: str,
    index: Sequence[rr.TimeColumn],
    jpegs: Sequence[np.ndarray],
) -> None:
    """One compressed picture per step."""
    columns = rr.EncodedImage.columns(blob=jpegs, media_type=["image/jpeg"] * len(jpegs))
    rec.send_columns(entity, index, columns)


def send_class_images(
    rec: rr.RecordingStream,
    entity: str,
    index: Sequence[rr.TimeColumn],
    images: Sequence[np.ndarray],
    draw_order: float | None = None,
) -> None:
    """Class images of one size, one per step."""
    n = len(images)
    height, width = images[0].shape
    image_format = rr.components.ImageFormat(width, height, color_model="L", channel_datatype="U8")
    draw_orders = None
    if draw_order is not None:
        draw_orders = [draw_order] * n
    columns = rr.SegmentationImage.columns(
        buffer=[image.reshape(-1) for image in images],
        format=[image_format] * n,
        opacity=[1.0] * n,
        draw_order=draw_orders,
    )
    rec.send_columns(entity, index, columns)


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


TRACK_CLASS, TRUTH_CLASS = 1, 3
"""Class of a mask's inside; the class of its edge is the next number."""
TRACK_EDGE_PX, TRUTH_EDGE_PX = 2, 1
OTHER_CLASS, GOAL_CLASS, YOURS_CLASS = 5, 6, 7
OUTLINES = {OTHER_CLASS: CAMERAS[0], GOAL_CLASS: GOAL, YOURS_CLASS: TARGET}
CLASSES = [
    rr.AnnotationInfo(id=0, label="", color=(0, 0, 0, 0)),
    rr.AnnotationInfo(id=TRACK_CLASS, label="track", color=(*ELECTED, 90)),
    rr.AnnotationInfo(id=TRACK_CLASS + 1, label="track, edge", color=(*ELECTED, 255)),
    rr.AnnotationInfo(id=TRUTH_CLASS, label="truth", color=(*TARGET, 1)),
    rr.AnnotationInfo(id=TRUTH_CLASS + 1, label="truth, edge", color=(*TARGET, 255)),
    *(rr.AnnotationInfo(id=i, label="", color=(*rgb, 255)) for i, rgb in OUTLINES.items()),
]
"""The edge has its own class so that track and truth stay apart where they agree."""


def class_image(mask: Mask, inside: int, edge_px: int) -> np.ndarray:
    """Class image of a mask: `inside`, and `inside + 1` on its outermost `edge_px` pixels."""
    raw = np.ascontiguousarray(mask).view(np.uint8)
    kernel = np.ones((2 * edge_px + 1, 2 * edge_px + 1), np.uint8)
    eroded = cv2.erode(raw, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return raw * np.uint8(inside + 1) - eroded


def track_image(mask: Mask) -> np.ndarray:
    """Class image of a tracked mask."""
    return class_image(mask, TRACK_CLASS, TRACK_EDGE_PX)


def send_masks(
    rec: rr.RecordingStream,
    header: EpisodeHeader,
    index: Sequence[rr.TimeColumn],
    frames: Sequence[Frame],
) -> None:
    """The track and the truth of every target; a lost track is an empty mask."""
    for camera in frames[0].cameras:
        groundings = header.groundings.get(camera.name, ())
        root = f"{image_root(camera.name)}/mask"
        for j in range(max(1, len(groundings))):
            suffix = target_suffix(j)
            if j < len(groundings):
                tracks = _track_images(camera, j, frames)
                send_class_images(
                    rec, f"{root}/target{suffix}", index, tracks, draw_order=float(TRACK_CLASS)
                )
            model = header.row.target if j == 0 else groundings[j].object
            truths = _truth_images(camera, model, frames)
            if truths is not None:
                send_class_images(
                    rec, f"{root}/gt{suffix}", index, truths, draw_order=float(TRUTH_CLASS)
                )


def _track_images(camera: Camera, j: int, frames: Sequence[Frame]) -> list[np.ndarray]:
    images = []
    for frame in frames:
        tracks = frame.tracks.get(camera.name, ())
        mask = tracks[j].mask if j < len(tracks) else None
        if mask is None:
            images.append(_empty_image(camera))
        else:
            images.append(track_image(mask))
    return images


def _truth_images(camera: Camera, model: str, frames: Sequence[Frame]) -> list[np.ndarray] | None:
    """None, when no frame has a true mask of the object."""
    images = []
    has_truth = False
    for frame in frames:
        mask = frame.truth.masks.get(camera.name, {}).get(model)
        if mask is None:
            images.append(_empty_image(camera))
        else:
            has_truth = True
            images.append(class_image(mask, TRUTH_CLASS, TRUTH_EDGE_PX))
    return images if has_truth else None


def _empty_image(camera: Camera) -> np.ndarray:
    return np.zeros((camera.height, camera.width), np.uint8)


CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
LABEL_SHARES = 0.27, 0.08
"""Width and height of an object's name, as shares of a picture's where there are several."""


def send_outlines(
    rec: rr.RecordingStream,
    header: EpisodeHeader,
    index: Sequence[rr.TimeColumn],
    frames: Sequence[Frame],
) -> None:
    """Every object's outline around its own pixels, and below it what it is to the user."""
    row = header.row
    labels = object_labels(list(header.object_sizes_m), row.target)
    classes = {row.goal: GOAL_CLASS, row.target: YOURS_CLASS}
    for camera in frames[0].cameras:
        images, lengths = [], []
        spots: list[tuple[float, float]] = []
        names: list[str] = []
        zoom = min(len(frames[0].cameras), 2) / 2
        room = zoom * LABEL_SHARES[0] * camera.width, zoom * LABEL_SHARES[1] * camera.height
        for frame in frames:
            owner, before = _empty_image(camera), len(names)
            for name, mask in frame.truth.masks.get(camera.name, {}).items():
                box = mask_box(mask)
                if box is not None and name in labels:
                    owner |= mask.view(np.uint8) * np.uint8(classes.get(name, OTHER_CLASS))
                    names.append(name)
                    spots.append(_label_spot(box, room, spots[before:], camera.height))
            images.append(np.where(owner == 0, cv2.dilate(owner, CROSS), 0).astype(np.uint8))
            lengths.append(len(names) - before)
        entity = f"{image_root(camera.name)}/identity"
        send_class_images(rec, entity, index, images)
        points = rr.Points2D.columns(
            positions=np.array(spots, np.float32).reshape(-1, 2),
            labels=[labels[name] for name in names],
            colors=[OUTLINES[classes.get(name, OTHER_CLASS)] for name in names],
        )
        rec.send_columns(f"{entity}/labels", index, points.partition(lengths))


def _label_spot(
    box: np.ndarray, room: tuple[float, float], taken: Sequence[tuple[float, float]], height: int
) -> tuple[float, float]:
    """Where the name of an object has room among those that stand: below its box, above it, or a
    line further down; below it, too, where none is free.
    """
    x0, y0, x1, y1 = box.tolist()
    x = (x0 + x1) / 2
    places = (y1 + 2, y0 - room[1], y1 + 2 + room[1])
    free = [
        y
        for y in places
        if y + room[1] < height
        and all(abs(x - a) > room[0] or abs(y - b) > room[1] for a, b in taken)
    ]
    return x, [*free, places[0]][0]


def send_attention(rec: rr.RecordingStream, frames: Sequence[Frame], jpeg_quality: int) -> None:
    """The share of attention on every image patch, and the overlays; `frames` have attention."""
    for camera, of_queries in frames[0].attention.items():
        for query in of_queries:
            overlays = []
            for frame in frames:  # rerun has no columns of tensors
                weights = frame.attention[camera][query]
                tensor = rr.Tensor(weights, dim_names=("layer", "head", "row", "column"))
                log_row(rec, f"/vap/attention/{camera}/{query}", tensor, at=frame_times([frame]))
                overlay = attention_overlay(frame.prompted[camera], heat_map(weights, query))
                overlays.append(encode_jpeg(overlay, jpeg_quality))
            entity = f"{image_root(camera)}/attention/{query}"
            send_jpegs(rec, entity, frame_times(frames), overlays)


def attention_overlay(rgb: Rgb, heat: np.ndarray) -> Rgb:
    """The dimmed picture with a heat map over it; the most attended patch is brightest."""
    height, width = rgb.shape[:2]
    share = cv2.resize(
        heat / max(float(heat.max()), 1e-9), (width, height), interpolation=cv2.INTER_LINEAR
    )
    bgr = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_INFERNO)
    colour = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    weight = (0.4 + 0.35 * share)[..., None]
    return ((1 - weight) * rgb + weight * colour).astype(np.uint8)
