"""The pictures of a recording, read back: JPEG or AV1, as they were kept."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vap_core.base.errors import BadRecording
from vap_core.base.types import Rgb
from vap_core.recording.entities.paths import image_root
from vap_core.recording.reading import read_chunks

BLOB, SAMPLE = "EncodedImage:blob", "VideoStream:sample"


def prompted_entities(path: Path) -> dict[str, str]:
    """The entity of what the policy saw, by camera, in the order of the file."""
    return by_camera(chunk.entity_path for chunk in read_chunks(path))


def by_camera(entities: Iterable[str]) -> dict[str, str]:
    """Those of some entities that are what the policy saw, by camera."""
    root = image_root("")
    found: dict[str, str] = {}
    for name in entities:
        if name.startswith(root) and name.endswith("/prompted"):
            found[name.removeprefix(root).removesuffix("/prompted")] = name
    return found


def read_pictures(path: Path, entities: set[str]) -> dict[str, dict[int, Rgb]]:
    """The pictures of some entities, by entity and control step.

    Raises: BadRecording, for a JPEG or a video that cannot be decoded whole.
    """
    jpegs: dict[str, dict[int, Any]] = {entity: {} for entity in entities}
    packets: dict[str, dict[int, Any]] = {entity: {} for entity in entities}
    for chunk in read_chunks(path):
        if chunk.entity_path not in entities:
            continue
        batch = chunk.to_record_batch()
        if "frame_index" not in batch.schema.names:
            continue
        steps = batch["frame_index"].to_pylist()
        for name, kept in ((BLOB, jpegs), (SAMPLE, packets)):
            if name in batch.schema.names:
                for step, cell in zip(steps, batch[name], strict=True):
                    blob = np.asarray(cell.values.flatten().to_numpy(), np.uint8)
                    kept[chunk.entity_path][step] = blob
    pictures = {}
    for entity in entities:
        pictures[entity] = {step: _decode_jpeg(blob) for step, blob in jpegs[entity].items()}
        if packets[entity]:
            in_order = dict(sorted(packets[entity].items()))
            decoded = _decode_video(list(in_order.values()))
            pictures[entity] = dict(zip(in_order, decoded, strict=True))
    return pictures


def _decode_jpeg(blob: np.ndarray) -> Rgb:
    bgr: Any = cv2.imdecode(blob, cv2.IMREAD_COLOR) if blob.size else None
    if bgr is None:
        raise BadRecording(
            "pictures: the recording holds a picture that is no JPEG; record the episode again."
        )
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8)


def _decode_video(packets: Sequence[np.ndarray]) -> list[Rgb]:
    """The pictures of an AV1 stream, one of each packet.

    Raises: BadRecording, when a packet cannot be decoded, or holds none or several pictures.
    """
    import av

    codec: Any = av.CodecContext.create("libdav1d", "r")
    pictures = []
    try:
        for data in [*packets, None]:
            packet = None if data is None else av.Packet(data.tobytes())
            for frame in codec.decode(packet):
                pictures.append(frame.to_ndarray(format="rgb24"))
    except (av.FFmpegError, ValueError) as error:
        raise BadRecording(
            f"pictures: the recording holds a video that cannot be decoded ({error}); "
            "record the episode again."
        ) from error
    if len(pictures) != len(packets):
        raise BadRecording(
            f"pictures: the recording holds a video of {len(packets)} steps that decodes to "
            f"{len(pictures)} pictures; record the episode again."
        )
    return pictures
