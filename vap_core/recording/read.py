"""Reading recordings back: their chunks and their properties."""

import warnings
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from rerun.chunk import Chunk, LazyChunkStream, RrdReader

from vap_core.base.errors import BadPhoto, BadRecording
from vap_core.base.files import check_regular
from vap_core.base.media import decode_picture, decode_video
from vap_core.base.types import Rgb
from vap_core.recording.colours import image_root

PROPERTIES = "/__properties"
"""Rerun's reserved entity; below it is one entity per property group."""

MOST_HZ = 1000
"""Control steps a second. A film repeats its last picture for seconds, which has to end."""
UNREADABLE = (RuntimeError, ValueError, OSError, Warning)
"""What rerun and the checks here raise at a file that is no whole recording."""


def read_chunks(path: Path) -> LazyChunkStream:
    """The chunks of a recording, in the order of the file.

    Raises: one of UNREADABLE; PermissionError for a file without rights.
    """
    check_regular(path)
    with path.open("rb"):  # Rerun's own error does not say which kind it is
        pass
    return RrdReader(path).stream()


def open_whole(path: Path) -> RrdReader:
    """A reader of a recording that was finished.

    Raises: one of UNREADABLE, for any other file.
    """
    check_regular(path)
    with warnings.catch_warnings():
        # Without a footer rerun only warns, and can read no single entity.
        warnings.simplefilter("error")
        return RrdReader(path)


def recording_id(path: Path) -> str:
    """The id of a recording."""
    return str(RrdReader(path).recordings()[0].recording_id)


def property_group(chunk: Chunk) -> str | None:
    """The property group that a chunk holds, None for any other chunk."""
    parent, _, group = chunk.entity_path.rpartition("/")
    return group if parent == PROPERTIES else None


def read_properties(chunk: Chunk) -> dict[str, Any]:
    """The properties in a chunk of one property group, without those that hold nothing."""
    batch = chunk.to_record_batch()
    cells = {n: batch[n][0].as_py() for n in batch.schema.names if not n.startswith("rerun.")}
    return {name: cell[0] for name, cell in cells.items() if cell and cell[0] is not None}


def read_summary(path: Path) -> dict[str, Any]:
    """What ran and how it ended, by the names of a results table's columns.

    `frames` counts the recorded steps. An unfinished recording has no `outcome`.

    Raises: BadRecording, when the file is missing, damaged, no recording, or may not be read.
    """
    path = Path(path)
    try:
        is_there = path.is_file()
    except OSError as err:
        raise refused(path, err) from err
    if not is_there:
        raise BadRecording(
            f"read_summary: there is no recording at {path}; check the path, or make one: eval or "
            "rollout with --record all."
        )
    summary: dict[str, Any] = {}
    steps: set[int] = set()
    try:
        with warnings.catch_warnings():
            # Rerun only warns when a footer is missing: such a file was never finished.
            warnings.simplefilter("error")
            for chunk in read_chunks(path):
                if property_group(chunk) in ("rollout", "outcome"):
                    summary |= read_properties(chunk)
                    continue
                batch = chunk.to_record_batch()
                if "frame_index" in batch.schema.names:
                    steps.update(batch["frame_index"].to_pylist())
    except PermissionError as err:
        raise refused(path, err) from err
    except UNREADABLE as err:
        raise unreadable(path, err) from err
    return {**summary, "frames": len(steps)}


def unreadable(path: Path, reason: object) -> BadRecording:
    """The error of a file that is no readable recording."""
    line = " ".join(str(reason).split())[-160:]
    return BadRecording(
        f"{path} cannot be read as a recording ({line}); "
        f"`rerun rrd optimize {quote(str(path))} -o mended.rrd` saves what can be saved."
    )


def refused(path: Path, error: OSError) -> BadRecording:
    """The error of a file or a folder that the system does not let this process read."""
    return BadRecording(
        f"{path} cannot be read ({error.strerror or error}); check its path and its permissions."
    )


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

    Raises: BadRecording, for a JPEG or a video that cannot be decoded whole, or is too large.
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
    try:
        for entity in entities:
            pictures[entity] = {
                step: decode_picture(BytesIO(blob.tobytes()), str(path), formats=("JPEG",))
                for step, blob in jpegs[entity].items()
            }
            if packets[entity]:
                in_order = dict(sorted(packets[entity].items()))
                decoded = decode_video(list(in_order.values()), "libdav1d", str(path))
                pictures[entity] = dict(zip(in_order, decoded, strict=True))
    except BadPhoto as error:
        raise BadRecording(f"pictures: {error} Record the episode again.") from error
    return pictures
