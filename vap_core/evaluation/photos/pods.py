"""PODS, as measure photos reads it: three references and twelve scenes with masks of each object.

Photos of 100 things of five kinds (S. Sundaram et al., Personalized Representation from
Personalized Generation, arXiv:2412.16156; MIT licence), from the Hugging Face hub. Only the 70
objects are taken whose results its authors report, as references the split `train`, as scenes
`test_dense`, whose masks are drawn. A scene has one object with a mask; the others in it have none.
"""

import io
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vap_core.base.csv_rows import write_rows
from vap_core.base.errors import BadPhotoSet
from vap_core.base.files import (
    kept_folder,
    parse_json,
    read_file,
    sha256_of,
    write_atomic,
    writing,
)
from vap_core.base.photos import PICTURE_FORMATS, load_photo
from vap_core.base.types import Mask
from vap_core.evaluation.photos.folder import BOXES_CSV, MASKS, OBJECTS_CSV, SCENES_CSV
from vap_core.perception.boxes import mask_box
from vap_core.perception.foundation.downloads import endpoint, transfer

REPO = "chaenayo/PODS"
INFO = "pods_info.json"
REFERENCES, SCENES = "data/train-", "data/test_dense-"
"""Beginnings of the files of each split, which are Parquet."""
REPORTED = "test"
"""The half of the objects whose results are reported; the others were for choosing settings."""
NAME = re.compile(r"\w{1,60}")
FOLDER = kept_folder("pods")
DOWNLOAD = "download"
ROWS = 16
"""Photos in memory at a time."""


def pods(
    folder: Path | None = None, origin: Path | None = None, say: Callable[[str], None] = print
) -> Path:
    """The folder with PODS in the form of measure photos, made on the first call.

    It is downloaded (170 MB) unless `origin` is a copy, as `hf download` leaves it.

    Raises: BadPhotoSet: it cannot be had, or is not what it should be; names the remedy. BadOutput:
        `folder` cannot be written.
    """
    folder = folder or FOLDER
    if (folder / SCENES_CSV).is_file():
        return folder
    if origin is None:
        origin = folder / DOWNLOAD
        try:
            _download(origin, say)
        except _failures() as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise BadPhotoSet(
                f"measure photos: {REPO} cannot be had from {endpoint()} ({reason:.150}); run it "
                f"again where there is internet, or there `hf download {REPO} --repo-type dataset "
                "--local-dir DIR`, and pass --from DIR."
            ) from error
    say(f"writing the objects and scenes of {REPO} into {folder}")
    _write(origin, folder)
    return folder


def _failures() -> tuple[type[Exception], ...]:
    from httpx import HTTPError

    return (OSError, HTTPError)


def _download(folder: Path, say: Callable[[str], None]) -> None:
    """Every file that is needed, with the SHA-256 that the hub gives of it."""
    from huggingface_hub import HfApi, hf_hub_url

    hub = HfApi(endpoint=endpoint(), token=False)
    about = hub.dataset_info(REPO, files_metadata=True)
    for file in about.siblings or []:
        name = file.rfilename
        if name != INFO and not name.startswith((REFERENCES, SCENES)):
            continue
        path = folder / name
        pinned = file.lfs.sha256 if file.lfs else None
        if path.is_file() and (pinned is None or sha256_of(path) == pinned):
            continue
        say(f"{REPO}/{name}")
        path.parent.mkdir(parents=True, exist_ok=True)
        url = hf_hub_url(REPO, name, repo_type="dataset", revision=about.sha, endpoint=endpoint())
        part = path.with_name(f".{path.name}.{str(about.sha)[:8]}.part")
        transfer(url, part, f"{REPO}/{name}")
        if pinned is not None and sha256_of(part) != pinned:
            part.unlink()
            raise OSError(f"the SHA-256 of {name} is not the hub's")
        os.replace(part, path)


def _write(origin: Path, folder: Path) -> None:
    """Convert a copy of the dataset; scenes.csv is written last. Raises: BadPhotoSet."""
    kinds = _reported_objects(origin)
    reference_boxes: list[tuple[str, ...]] = [("photo", "x0", "y0", "x1", "y1")]
    for name, photo, mask in _photos(origin, REFERENCES, kinds, folder / "references"):
        reference_boxes.append((f"{name}/{photo.name}", *_box(mask, photo)))
    scene_boxes: list[tuple[str, ...]] = [("scene", "object", "x0", "y0", "x1", "y1")]
    for name, photo, mask in _photos(origin, SCENES, kinds, folder / "scenes"):
        scene_boxes.append((photo.name, name, *_box(mask, photo)))
        target = folder / MASKS / photo.name / f"{name}.png"
        _write_file(target, cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes())
    with writing(folder, "measure photos"):
        write_rows(folder / BOXES_CSV, reference_boxes)
        write_rows(folder / OBJECTS_CSV, [("object", "category"), *kinds.items()])
        write_rows(folder / SCENES_CSV, scene_boxes)


def _reported_objects(origin: Path) -> dict[str, str]:
    """The kind of every object that is measured."""
    path = origin / INFO
    try:
        about = parse_json(read_file(path))
        kinds = {
            name: about["class_to_sc"][name]
            for name in about["classes"]
            if about["class_to_split"][name] == REPORTED
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadPhotoSet(
            f"measure photos: {path} does not tell objects from kinds ({error!s:.100}); fetch all "
            f"of {REPO} again."
        ) from error
    bad = [name for name in kinds if not NAME.fullmatch(name)]
    if bad or not kinds:
        raise BadPhotoSet(f"measure photos: {path} names no objects, or {bad}; fetch it again.")
    return kinds


def _photos(
    origin: Path, beginning: str, kinds: dict[str, str], folder: Path
) -> Iterator[tuple[str, Path, Mask]]:
    """Every photo of the measured objects, written, with its object and its mask.

    References have a folder for each object, scenes are named by theirs.
    """
    count: dict[str, int] = {}
    for row in _rows(origin, beginning):
        name = row["label"]
        if name not in kinds:
            continue
        count[name] = count.get(name, -1) + 1
        stem = f"{name}-{count[name]:02d}" if beginning == SCENES else f"{count[name]}"
        place = folder if beginning == SCENES else folder / name
        photo = _keep(row["image"]["bytes"], place, stem)
        yield name, photo, _mask(row["mask"]["bytes"], photo)
    if set(count) != set(kinds):
        raise BadPhotoSet(
            f"measure photos: {origin}/{beginning}*.parquet has photos of {len(count)} of the "
            f"{len(kinds)} objects; fetch all of {REPO} again."
        )


def _rows(origin: Path, beginning: str) -> Iterator[dict[str, Any]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = ["image", "mask", "label"]
    for path in sorted(origin.glob(f"{beginning}*.parquet")):
        try:
            with pq.ParquetFile(path) as table:
                for batch in table.iter_batches(batch_size=ROWS, columns=columns):
                    yield from batch.to_pylist()
        except (pa.ArrowException, KeyError) as error:
            raise BadPhotoSet(
                f"measure photos: {path} cannot be read ({error!s:.100}); fetch it again."
            ) from error


def _keep(data: bytes, folder: Path, stem: str) -> Path:
    """The photo as it came, under a suffix that says what it is."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=PICTURE_FORMATS) as image:
            suffix = str(image.format).lower().replace("jpeg", "jpg")
    except (UnidentifiedImageError, TypeError) as error:
        raise BadPhotoSet(
            f"measure photos: the photo {stem} of {REPO} is no image ({error!s:.100}); fetch it "
            "again."
        ) from error
    path = folder / f"{stem}.{suffix}"
    _write_file(path, data)
    return path


def _mask(data: bytes, photo: Path) -> Mask:
    """A mask's picture, whatever it calls bright, held against its photo. Raises: BadPhotoSet."""
    drawn = _keep(data, photo.parent, f".{photo.stem}-mask")
    picture = load_photo(drawn, long_side=None).max(axis=2)
    drawn.unlink()
    size = load_photo(photo, long_side=None).shape[:2]
    if picture.shape != size:
        raise BadPhotoSet(
            f"measure photos: the mask of {photo} has {picture.shape} pixels, the upright photo "
            f"{size}; report it to {REPO}."
        )
    return picture > picture.max() / 2


def _box(mask: Mask, photo: Path) -> tuple[str, ...]:
    box = mask_box(mask)
    if box is None:
        raise BadPhotoSet(f"measure photos: the mask of {photo} is empty; report it to {REPO}.")
    return tuple(f"{value:g}" for value in box)


def _write_file(path: Path, data: bytes) -> None:
    """Raises: BadOutput."""
    with writing(path, "measure photos"):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, data)
